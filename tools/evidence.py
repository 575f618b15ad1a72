"""Evidence on real frames for the repository: what `make figures` gives on them, and more.

`make evidence KITTI=...` runs `make figures PROFILE=thesis` with all sequences of a KITTI folder
and the label maps of the model in the package. Then this program copies the tables, the runs and
the figures that show no frame of the data. It adds what the streets show, few keypoints, the same
with every second frame, and the refined estimator with masks of every width. It says what is left.
A stopped run resumes. The frames of the manifest (`make excerpts`) are written to
figures/kitti_excerpts, other frames beside it.
"""

import time
from pathlib import Path

import numpy as np
import pandas as pd

from keypoint_study import comparisons, jobs, ratios, runner
from keypoint_study.report import style, texts
from keypoint_study.sources import Source
from thesis import claims, equal_number, few_keypoints, real_frames, timing, views
from thesis.run_settings import read_settings
from thesis_repro.data import kitti
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import THESIS, metrics
from thesis_repro.odometry.loop import detect
from thesis_repro.running import program, provenance
from thesis_repro.running.files import needed, write_text

FOLDER = real_frames.FOLDER
# Figures and tables of notebooks 8 and 9. Other notebooks draw frames, which are not ours to give.
KEPT = (
    *(f"figure_4_{number:02d}" for number in (6, 7, *range(9, 18))),
    *(f"table_4_{number}" for number in (1, 2, 3)),
    "comparison",
    "widths",
    "audit",
    "budget",
)
PAIRS = 6  # of frames of each sequence, in which keypoints are found again
RUNS = ("runs", "shuffled_runs", "ablations")  # tables of runs in the build folder
# What the sequences show at their start: 00 to 10 are KITTI odometry's, the others raw drives.
STREETS = {
    "00": "a residential street with parked cars",
    "01": "a ramp onto a motorway",
    "02": "a main road, then a turn into a road between trees",
    "03": "a residential street between trees, up to a junction",
    "04": "a main road out of a town, behind a van",
    "05": "a residential street with few parked cars",
    "06": "a straight street past a building site, with parked cars",
    "07": "a street of a town with shops and parked cars",
    "drive0005": "a town; a van and a cyclist move ahead, a pedestrian crosses",
    "drive0009": "a street past shops, with parked cars",
    "drive0095": "a residential street with parked cars",
}

texts.TEMPLATES.loader.searchpath.append(str(Path(__file__).parent))


def opened(settings):
    """Return the sequences of a run, as its notebooks take them."""
    return [
        Sequence(settings.kitti, name).subset(settings.sizes.frames)
        for name in kitti.sequences(settings.kitti)
    ]


@style.applied()
def write(settings, folder):
    """Write all tables, plots and findings into a folder.

    settings: of a finished `make figures` on real frames. Raises InputError if a file is missing.
    """
    sequences = opened(settings)
    labels = needed(settings.build / "labels", "05_prediction")
    lengths = ", ".join(f"{sequence.name} ({len(sequence)} frames)" for sequence in sequences)
    note = f"odometry: real KITTI frames, {lengths}; label maps by the model in the package"
    few_folder = settings.build / "few_keypoints"
    parts = {
        "few keypoints": lambda: few_keypoints.run_few(
            sequences, labels, few_folder, settings.jobs, few_keypoints.REPETITIONS
        ),
        "every second frame": lambda: runs_of_every_second(settings, sequences, labels),
        "their times": lambda: timing.times(
            settings, "few_keypoints", lambda: few_keypoints.time_steps(sequences[0], labels)
        ),
        "refined estimator, every width": lambda: runs_of_widths(settings, sequences, labels),
    }
    made = []
    for place, (name, make) in enumerate(parts.items()):
        print(f"left: {'; '.join(list(parts)[place:])}", flush=True)
        started = time.monotonic()
        made.append(make())
        print(f"{name}: done in {time.monotonic() - started:.0f} s", flush=True)
    few_runs, second_runs, times, of_widths = made
    few = few_keypoints.ratios_to_all(few_runs)
    streets = _streets(sequences)
    provenance.sweep(folder)
    for name in KEPT:
        _copy(settings.figures, name, folder)
    if not settings.cityscapes_is_embedded:
        _copy(settings.figures, "figure_4_01", folder)
    (folder / "audit.md").unlink()  # the page beside the gallery has its numbers, too
    style.save_figure(few_keypoints.figure_of_few(few), folder, "few_keypoints", note)
    for_readers = {
        "streets": streets,
        "few_keypoints": few_keypoints.table_of_few(few, times),
        "every_second": few_keypoints.table_of_few(few_keypoints.ratios_to_all(second_runs)),
        "refined_widths": table_of_widths(of_widths),
    }
    for name, rows in for_readers.items():
        timed_on = f"; {timing.told(times)}" if name == "few_keypoints" else ""
        style.save_table(rows, folder, name, note + timed_on)
    of_runs = {name: _read(settings, name) for name in RUNS} | {
        "few_keypoints_runs": few_runs,
        "every_second_runs": second_runs,
        "refined_widths_runs": of_widths,
        "found_again": found_again(sequences, labels),
        "ends": ends(settings, sequences),
    }
    for name, rows in of_runs.items():
        # six digits are enough: shuffling the matched points changes more
        text = rows.to_csv(index=False, lineterminator="\n", float_format="%.6g")
        write_text(folder / f"{name}.csv", text)
    seconds = timing.folder(settings) / "seconds.csv"
    if seconds.is_file():
        write_text(folder / "timings" / "seconds.csv", seconds.read_text(encoding="utf-8"))
    equal_number.write(of_runs.__getitem__, folder, note)
    claims.write(folder, note)
    findings = needed(settings.figures / "findings.md", "08_results").read_text(encoding="utf-8")
    write_text(
        folder / "README.md",
        texts.render(
            "evidence.md.j2",
            findings=findings,
            streets=style.markdown(streets),
            tables={
                name: (folder / f"{name}.md").read_text(encoding="utf-8")
                for name in KEPT
                if name.startswith("table")
            },
        ),
    )


def _read(settings, name):
    path = needed(settings.build / f"{name}.csv", "08_results and 09_audit")
    return pd.read_csv(path, dtype={"sequence": str, "source": str}).fillna({"source": ""})


def _copy(source, name, folder):
    """Copy the files of a figure or table. Raises InputError if there are none."""
    paths = sorted(source.glob(f"{name}.*"))
    if not paths:
        raise InputError(f"{source / name}: is missing; make figures on the same data writes it")
    for path in paths:
        write_text(folder / path.name, path.read_text(encoding="utf-8"))


def runs_of_every_second(settings, sequences, labels):
    """Run masks and few spread keypoints with every second frame: KITTI at 5 frames a second."""
    folder = settings.build / "every_second"
    thinned = [
        real_frames.cut(each, 0, len(each) - 1, folder / "frames", each.name, every=2)
        for each in sequences
    ]
    return few_keypoints.run_few(
        thinned,
        labels,
        folder / "runs",
        settings.jobs,
        few_keypoints.REPETITIONS,
        only=few_keypoints.EVERY_SECOND,
    )


def runs_of_widths(settings, sequences, labels):
    """Run the refined estimator with all keypoints and with masks of every width, once each.

    Shuffling the matched points hardly changes its paths, so one run is enough.
    """
    kinds = [("baseline", None), *(("masked", width) for width in settings.sizes.widths)]
    planned = [
        jobs.Job(sequence.name, method, width, estimator="refined")
        for sequence in sequences
        for method, width in kinds
    ]
    folder = settings.build / "refined_widths"
    return runner.run_all(
        jobs.runs_of(planned, sequences, [Source(labels)]), folder, processes=settings.jobs
    ).table


def found_again(sequences, labels):
    """Count the keypoints that the next frame does not find, in PAIRS of frames of each sequence.

    One row a pair and choice: all keypoints, those on the mask, and as many of the strongest.
    """
    rows = []
    for sequence in sequences:
        masks = Source(labels).masks(sequence, jobs.CONTROL_WIDTH)
        for index in np.linspace(0, len(sequence) - 2, PAIRS).round().astype(int):
            frames = [sequence.frame(number) for number in (index, index + 1)]
            on_mask = [masks[number] for number in (index, index + 1)]
            chosen = {"all": [None, None], "mask": on_mask}
            chosen["strongest"] = [
                _strongest(frame, len(detect(frame, THESIS, mask)))
                for frame, mask in zip(frames, on_mask, strict=True)
            ]
            for choice, of_both in chosen.items():
                again, _, lost, _ = views.found_again(*frames, *of_both)
                detected = len(again) + len(lost)
                rows.append([sequence.name, index, choice, detected, len(lost)])
    return pd.DataFrame(rows, columns=["sequence", "frame", "choice", "detected", "lost"])


def _strongest(frame, number):
    """Return a mask that keeps the strongest keypoints of a frame, one pixel each."""
    mask = np.zeros_like(frame)
    columns, rows = detect(frame, THESIS)[:number].astype(int).T
    mask[rows, columns] = 255
    return mask


def ends(settings, sequences):
    """Return how far both ends of a true path are apart, and by how much paths miss its end.

    Metres; one row a run with all keypoints and the thesis's estimator.
    """
    runs = comparisons.of_method(_read(settings, "runs"), "baseline", "thesis")
    true = {sequence.name: sequence.poses for sequence in sequences}
    rows = []
    for (name, run), poses in runner.run_poses(runs, settings.build / "odometry").items():
        first, last = true[name][0, :3, 3], true[name][-1, :3, 3]
        metres = metrics.travelled(true[name])[-1]
        apart, missed = np.linalg.norm(first - last), np.linalg.norm(poses[-1, :3, 3] - last)
        rows.append([name, run, metres, apart, missed])
    return pd.DataFrame(rows, columns=["sequence", "run", "metres", "between ends", "missed"])


def table_of_widths(runs):
    """Return one row a width: errors divided by those with all keypoints, and what fails."""
    everything = comparisons.of_method(runs, "baseline", "refined")
    masked = comparisons.of_method(runs, "masked", "refined")
    rows = []
    for width, of_width in masked.groupby("dilation_width"):
        row = {"dilation width (pixels)": int(width)}
        row["keypoints"] = f"{of_width['mean_keypoints'].mean():.0f}"
        for error, title in comparisons.JUDGING_METRICS.items():
            ratio = ratios.typical_ratio(ratios.ratios_of(of_width, everything, error))
            row[title] = f"{texts.short(ratio)}, {ratio['above']} of {ratio['n']} above 1"
        failed = ratios.has_failed(of_width.set_index("sequence"))
        rows.append(row | {"streets that fail": ratios.count_failing(failed)})
    return pd.DataFrame(rows)


def _streets(sequences):
    """Return what each sequence shows, its length (metres) and the sum of its turns (degrees).

    A turn is the yaw of a step, its rotation about the camera's axis down. Pitch and roll, which a
    road's unevenness gives, are no turns.
    """
    rows = []
    for sequence in sequences:
        steps = np.linalg.inv(sequence.poses[:-1]) @ sequence.poses[1:]
        yaw = np.degrees(np.arctan2(steps[:, 0, 2], steps[:, 2, 2]))
        rows.append(
            {
                "sequence": sequence.name,
                "frames": len(sequence),
                "metres": round(metrics.travelled(sequence.poses)[-1]),
                "turns (degrees)": round(np.abs(yaw).sum()),
                "street": STREETS.get(sequence.name, ""),
            }
        )
    return pd.DataFrame(rows)


def folder_of(settings):
    """Return the folder of the evidence: the one in git for its own frames alone, at its sizes."""
    if real_frames.is_evidence(settings):
        return FOLDER
    program.log.info(
        "evidence: these are not the frames and sizes of the evidence in git, which stays as it is"
    )
    return settings.published.with_name(f"{settings.published.name}-evidence")


def main():
    """Write the evidence with the settings of the environment."""
    settings = read_settings()
    with provenance.claimed(settings.build / "evidence"):
        folder = folder_of(settings)
        write(settings, folder)
        program.summary(f"tables, plots and findings: {folder}")


if __name__ == "__main__":
    program.run_main(main)
