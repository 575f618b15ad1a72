"""Evidence on real frames for the repository: tables, plots and findings.

They contain no frame of the data.

`make evidence KITTI=...` uses all sequences of a KITTI folder and the label maps of the model in
the package. It runs the thesis's masks, the controls of one width with both estimators, and the
audit's ablations. LABELS=... names further folders of label maps, whose masks are compared with
those of the package on the sequences that they have. A stopped run resumes.
"""

import os
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

import failures
import label_quality
from thesis_repro import masks
from thesis_repro.data import kitti
from thesis_repro.data.cityscapes import read_label_map
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.report import audit, comparison, style, texts
from thesis_repro.running import console, results
from thesis_repro.running.files import write_text
from thesis_repro.running.settings import PREFIX, ROOT, read_settings
from thesis_repro.segmentation import prediction
from thesis_repro.study import ablations, compare, controls, jobs, runner, thesis_tables
from thesis_repro.study.sources import Source, named

# BUILD: label maps and runs
FOLDER, BUILD = ROOT / "figures" / "kitti_excerpts", ROOT / "build" / "evidence"
# pixels, of masks with the thesis's estimator
WIDTHS = (3, 5, 7, 9, jobs.CONTROL_WIDTH, 11, 13, 15)
SAMPLED_FRAMES = 12  # frames of each sequence in which boundaries and tracks are measured
# What the sequences show at their start: 00 to 10 are KITTI odometry's, the others raw drives.
STREETS = {
    "00": "a residential street with parked cars",
    "01": "a slip road onto a motorway",
    "02": "a main road, then a turn into a road between trees",
    "05": "a residential street with few parked cars",
    "06": "a straight street past a building site, with parked cars",
    "07": "a street of a town with shops and parked cars",
    "drive0005": "a town; a van and a cyclist move ahead, a pedestrian crosses",
    "drive0095": "a residential street with parked cars",
}

texts.TEMPLATES.loader.searchpath.append(str(Path(__file__).parent))


@style.applied()
def write(root, folder, build, frames=None, repetitions=5, processes=1, others=()):
    """Run the missing jobs and write all tables, plots and findings into a folder.

    root: the KITTI folder. build: keeps label maps and runs; folder and build are absolute paths.
    frames: how many frames of each sequence to use, None for all. others: further sources of label
    maps, for some or all sequences. Raises InputError if one is for none.
    """
    results.stage(build, results="evidence")
    labels, model = build / "labels", prediction.load_shipped()
    sequences = [kitti.Sequence(root, name).subset(frames) for name in kitti.sequences(root)]
    for sequence in sequences:
        prediction.write_label_maps(model, sequence.frame_paths, labels / sequence.name)
    names = [sequence.name for sequence in sequences]
    covered = {
        source.name: [name for name in names if source.sequence_folder(name).is_dir()]
        for source in others
    }
    for source in others:
        if not covered[source.name]:
            raise InputError(
                f"{source.folder}: holds no folder of label maps of {', '.join(names)}"
            )
    run = partial(
        runner.run_jobs,
        sequences=sequences,
        sources=[Source(labels), *others],
        folder=build / "odometry",
        processes=processes,
    )
    runs = _runs(run, sequences, repetitions)
    other_runs = {
        source: run(
            [
                jobs.Job(
                    name,
                    "masked",
                    jobs.CONTROL_WIDTH,
                    estimator="refined",
                    repetition=repetition,
                    source=source,
                )
                for name in source_names
                for repetition in range(repetitions)
            ]
        ).table
        for source, source_names in covered.items()
    }
    ablated = ablations.measure(
        sequences,
        labels,
        build / "audit",
        repetitions=repetitions,
        baseline_repetitions=max(10, repetitions),
        processes=processes,
    )
    measurements = [
        *audit.of_tables(),
        *audit.of_ablations(ablated),
        *audit.of_study(runs),
        *audit.measured(_boundaries(sequences, labels), "boundaries"),
        *audit.measured(_tracks(sequences, labels), "tracks"),
    ]
    label_masks = [
        masks.LabelMasks(labels / sequence.name, sequence, jobs.CONTROL_WIDTH)
        for sequence in sequences
    ]
    steps = pd.concat(map(failures.measure, sequences, label_masks), ignore_index=True)
    lengths = ", ".join(f"{sequence.name} ({len(sequence)} frames)" for sequence in sequences)
    note = f"odometry: real KITTI frames, {lengths}; label maps by the model in the package"
    table, qualities = compare.comparisons(runs), label_quality.table(runs, other_runs)
    streets = _streets(sequences)
    results.sweep(folder)
    style.save_all(
        {
            "comparison": comparison.figure_comparison(table),
            "failures": failures.figure(steps, sequences, label_masks),
            "label_quality": label_quality.figure(qualities),
        },
        {
            "comparison": comparison.table_comparison(table),
            "failures": failures.table(steps),
            "widths": comparison.table_widths(runs),
            "streets": streets,
            "label_quality": qualities,
            "audit": audit.table(measurements),
        },
        folder,
        note,
    )
    for name, rows in {"runs": runs, "switches": ablated}.items():
        # six digits are enough: shuffling the matched points changes more
        write_text(
            folder / f"{name}.csv",
            rows.to_csv(index=False, lineterminator="\n", float_format="%.6g"),
        )
    write_text(
        folder / "README.md",
        texts.render(
            "evidence.md.j2",
            findings=texts.findings(runs, table, note, embedded=False),
            streets=style.markdown(streets),
            width=jobs.CONTROL_WIDTH,
        ),
    )


def _runs(run, sequences, repetitions):
    """Return the runs of the comparison. run: returns the runs of jobs.

    The runs with masks decide the jobs with fewer keypoints.
    """
    planned = jobs.first_jobs(
        sequences,
        {"thesis": WIDTHS, "refined": []},
        tested=jobs.CONTROL_WIDTH,
        repetitions=repetitions,
    )
    runs = run(planned).table
    planned += jobs.reduced_jobs(
        thesis_tables.best_widths(compare.of_method(runs, "masked")), repetitions
    )
    planned += jobs.keypoint_control_jobs(
        compare.keypoints_left(runs), sequences, repetitions, width=jobs.CONTROL_WIDTH
    )
    return run(planned).table


def _streets(sequences):
    """Return what each sequence shows, its length (metres) and the sum of its turns (degrees)."""
    rows = []
    for sequence in sequences:
        steps = np.linalg.inv(sequence.poses[:-1]) @ sequence.poses[1:]
        rows.append(
            {
                "sequence": sequence.name,
                "frames": len(sequence),
                "metres": round(metrics.travelled(sequence.poses)[-1]),
                "turns (degrees)": round(metrics.angles(steps[:, :3, :3]).sum()),
                "street": STREETS.get(sequence.name, ""),
            }
        )
    return pd.DataFrame(rows)


def _boundaries(sequences, labels):
    """Return the measures of `ablations.boundaries` in SAMPLED_FRAMES frames of each sequence."""
    rows = []
    for sequence in sequences:
        step = max(1, len(sequence) // SAMPLED_FRAMES)
        for index in range(0, len(sequence), step):
            label_map = read_label_map(labels / sequence.name / sequence.frame_paths[index].name)
            measures = ablations.boundaries(label_map, sequence.size)
            rows.append({"sequence": sequence.name, "frame": index} | measures)
    return pd.DataFrame(rows)


def _tracks(sequences, labels):
    rows = []
    for sequence in sequences:
        label_maps, width = labels / sequence.name, jobs.CONTROL_WIDTH
        masks_by_name = {
            "all keypoints": None,
            "masks": masks.LabelMasks(label_maps, sequence, width),
            "exact boundaries": masks.LabelMasks(
                label_maps, sequence, width, masks.MaskSettings("exact")
            ),
            "random lines": controls.masks_of_method(
                "random-lines", Source(labels), sequence, width
            ),
        }
        rows.append(ablations.tracks(sequence, masks_by_name, SAMPLED_FRAMES))
    return pd.concat(rows, ignore_index=True)


def main():
    """Write the evidence with the settings of the environment."""
    # all frames, unless FRAMES is set
    settings = read_settings(os.environ | {f"{PREFIX}PROFILE": "thesis"})
    with results.claimed(BUILD), console.logged(BUILD, "tables, plots and findings") as run:
        write(
            settings.kitti,
            FOLDER,
            BUILD,
            settings.sizes.frames,
            settings.sizes.repetitions,
            settings.jobs,
            named([("labels", Path(path)) for path in sys.argv[1:]], [], masks.MaskSettings()),
        )
        run.end(f"tables, plots and findings: {FOLDER}")


if __name__ == "__main__":
    console.run_main(main)
