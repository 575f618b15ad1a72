"""What all of this shows on real frames, for the repository: tables, plots and words, and no frame of the data in them.

`python -m thesis_repro.report.evidence KITTI FOLDER` (make evidence) takes the sequences in a KITTI folder, label maps
of the model in the package, the thesis's masks and the controls of one width under both estimators, and the audit's
switches. What is compared with what was decided beforehand (`study.answer`). A stopped run goes on where it was.
"""

import argparse
import os
import sys
from pathlib import Path

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import matplotlib

matplotlib.use("Agg")

import pandas as pd

from thesis_repro import InputError, kitti, longrun, masks, stages
from thesis_repro.cityscapes import read_label_map
from thesis_repro.files import write_text
from thesis_repro.odometry.refined import boresight
from thesis_repro.report import audit, comparison, findings, outcome, style, tables
from thesis_repro.study import answer, controls, effects, jobs, results, runner
from thesis_repro.study.sources import Source

LARGEST = 3_000_000  # bytes, of everything together
WIDTHS = (3, 5, 7, 9, jobs.CONTROL_WIDTH, 11, 13, 15)  # pixels, of masks under the thesis's estimator
# Beside the tested width, for the lines of error against number of keypoints: under the estimator that judges alone.
OTHER_WIDTHS, OTHER_REPETITIONS = (5, 15), 3
LINES = ("masked", "exact-boundaries", "corrected", "mirrored", "random-lines", "image-edges")  # that have a width
LOOKED_AT = 12  # frames of each sequence whose boundaries and keypoints are looked at one by one


def write(root, folder, build, *, frames=None, repetitions=5, processes=1):
    """Run what is missing and write everything into a folder; returns its files.

    root: of KITTI. build: folder for label maps and runs. frames: of each sequence, None for all.
    Raises InputError where the files are larger than LARGEST together, or where the folder holds anything else.
    """
    root, build = Path(root).absolute(), stages.stage(Path(build).absolute(), root=str(root), frames=frames)
    names = kitti.sequences(root)
    _predict(root, names, build / "labels", frames)
    tested, every = _runs(root, names, build, frames, repetitions, processes)
    plan = effects.Plan(orders=repetitions, chance=max(10, repetitions), frames=frames)
    switches, prefixes = effects.measure(root, names, build / "labels", build / "audit", plan, processes)
    sequences = [kitti.Sequence(root, name).subset(frames) for name in names]
    length = ", ".join(f"{sequence.name} ({len(sequence)} frames)" for sequence in sequences)
    note = f"odometry: real KITTI frames, {length}; label maps by the model in the package"
    folder = Path(folder)
    longrun.sweep(folder)
    found = [*audit.arithmetic(), *audit.of_switches(switches), *audit.of_chance(prefixes), *audit.of_runs(tested),
             *audit.of_boresight(boresight.explained(answer.refined_paths(names, root, build / "odometry", frames))),
             *audit.of_boundaries(_boundaries(sequences, build / "labels")),
             *audit.of_tracks(_tracks(sequences, build / "labels"))]
    words = {"answer_in_words": comparison.words(tested, note), "findings": findings.words(tested, note)}
    for name, table in {"answer": comparison.table(tested), "audit": audit.table(found, note),
                        "controls": tables.table_controls(tested), "widths": tables.table_widths(tested),
                        "runs": _short(every), "switches": _short(switches)}.items():
        style.save_table(table, folder, name, note)
    for name in ("runs", "switches"):  # thousands of rows are for programs
        (folder / f"{name}.md").unlink()
    for name, figure in {"answer": comparison.figure_answer(tested, every),
                         "answer_sequences": comparison.figure_by_sequence(every, "turned"),
                         "answer_rotation": comparison.figure_by_sequence(every, "rotation"),
                         "controls": outcome.figure_controls(tested)}.items():
        style.save_figure(figure, folder, name, note)
    for name, text in words.items():
        write_text(folder / f"{name}.md", text)
    write_text(folder / "README.md", _page(note, words))
    files = sorted(path for path in folder.iterdir() if path.is_file())
    size = sum(path.stat().st_size for path in files)
    if size > LARGEST:
        raise InputError(f"{folder}: {size:,} bytes, more than the {LARGEST:,} that may go into the repository")
    return files


def _predict(root, names, labels, frames):
    from thesis_repro.segmentation import prediction  # TensorFlow takes seconds to load

    model = prediction.load_shipped()
    for name in names:
        prediction.write_label_maps(model, kitti.Sequence(root, name).subset(frames).frame_paths, labels / name)


def _runs(root, names, build, frames, repetitions, processes):
    """(the runs of the comparison, these and those of other widths and limits), with relative errors."""
    def run(some):
        return runner.run(some, root, build / "labels", build / "odometry", frames=frames, processes=processes)

    tested = jobs.first_jobs(names, WIDTHS, repetitions) + jobs.mask_control_jobs(root, names, repetitions)
    fewer = min(repetitions, OTHER_REPETITIONS)
    other = [jobs.Job(name, method, width, estimator=answer.POSE, repetition=repetition) for name in names
             for method in LINES for width in OTHER_WIDTHS for repetition in range(fewer)]
    summary = run([*tested, *other])
    first = summary[summary["run"].isin({job.name for job in tested})]
    tested += jobs.reduced_jobs(results.best_widths(first), repetitions)
    tested += jobs.keypoint_control_jobs(results.keypoints_left(first), root, frames, repetitions)
    for width in OTHER_WIDTHS:
        left = summary[(summary["method"] == "masked") & (summary["dilation_width"] == width)]
        limited = jobs.keypoint_control_jobs(left.groupby("sequence")["mean_keypoints"].mean(), root, frames, fewer)
        other += [job for job in limited if job.estimator == answer.POSE]
    keys = {(job.sequence, job.name) for job in tested}
    every = answer.with_relative(run([*tested, *other]), root, build / "odometry", frames)
    chosen = [key in keys for key in zip(every["sequence"], every["run"], strict=True)]
    return every[chosen].reset_index(drop=True), every


def _boundaries(sequences, labels):
    return pd.DataFrame([
        effects.boundaries(read_label_map(labels / sequence.name / sequence.frame_paths[index].name), sequence.size)
        for sequence in sequences for index in range(0, len(sequence), max(1, len(sequence) // LOOKED_AT))])


def _tracks(sequences, labels):
    rows = []
    for sequence in sequences:
        own, width = labels / sequence.name, jobs.CONTROL_WIDTH
        kinds = {"all keypoints": None, "masks": masks.LabelMasks(own, sequence, width),
                 "exact boundaries": masks.LabelMasks(own, sequence, width, "exact"),
                 "random lines": controls.masks("random-lines", Source(labels), sequence, width)}
        rows.append(effects.tracks(sequence, kinds, LOOKED_AT))
    return pd.concat(rows, ignore_index=True)


def _short(table):
    """Six digits are more than any order of the correspondences leaves alone."""
    numbers = table.select_dtypes("float").columns
    return table.assign(**{name: [float(f"{value:.6g}") for value in table[name]] for name in numbers})


def _page(note, words):
    return f"""# On real frames

{note}. `make evidence KITTI=/path/to/kitti` made this folder; no frame of KITTI is in it.

{words["answer_in_words"]}
![Error against number of keypoints](answer.svg)

*How many times the error of all keypoints each method has, under both estimators: {"[in numbers](answer.md)"}.*

![RMSE of each sequence](answer_sequences.svg)

*Each sequence, refined estimator, RMSE without the constant angle; [single rotations](answer_rotation.svg).*

![Masks and controls](controls.svg)

*Changes in percent, as the thesis has them: [in numbers](controls.md), [in words](findings.md).*

- [widths.md](widths.md): the best width of each sequence, and how far it is chance
- [audit.md](audit.md): where the thesis contradicts itself, its code or its libraries, and what each of that does here
- [runs.csv](runs.csv), [switches.csv](switches.csv): every run
"""


def main(arguments=None):
    parser = argparse.ArgumentParser(description="tables, plots and findings on real frames, without any frame")
    parser.add_argument("kitti", type=Path, help="folder that holds sequences and poses")
    parser.add_argument("folder", type=Path, help="where to write")
    parser.add_argument("--build", type=Path, default=Path("build/evidence"), help="label maps and runs")
    parser.add_argument("--frames", type=int, help="from the start of each sequence (all)")
    parser.add_argument("--repetitions", type=int, default=5, help="of every run (5)")
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at once")
    options = parser.parse_args(arguments)
    try:
        with longrun.claimed(options.build), longrun.logged(options.build, "tables, plots and findings") as run:
            files = write(options.kitti, options.folder, options.build, frames=options.frames,
                          repetitions=options.repetitions, processes=options.jobs)
            run.end(f"{options.folder}: {len(files)} files, {sum(path.stat().st_size for path in files):,} bytes")
    except Exception as error:
        return longrun.report_error(error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
