"""Estimate how long the missing runs take on this machine: the code is timed on a few frames and
the times are multiplied.

Times are for one core. On a busy machine they can be wrong by a third.
"""

import time
from collections.abc import Callable, Iterable
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from thesis_repro import InputError, kitti, odometry
from thesis_repro.settings import Profile, cores
from thesis_repro.study import ablations, compare, jobs, runner
from thesis_repro.study.sources import Source
from thesis_repro.study.study import Study

# frames of two timed runs: their difference leaves out the cost of starting a run
SHORT, LONG = 3, 9
LABEL_MAP_BYTES, ROW_BYTES = 6_000, 450  # of a label map, and of a frame of a run
# of a notebook and of a study, whatever the number of frames: imports, figures, small examples
NOTEBOOK_SECONDS, STUDY_SECONDS = 16, 20
RUNS_IN_07 = 7  # cost of notebook 7, in runs with all keypoints over its sequence


def of_study(study: Study, folder: Path) -> dict[str, Any]:
    """Return the plan of the runs of a study with your own masks that are not in its folder yet,
    see `_plan`.
    """
    # the keypoint controls of each source are planned when the masked runs are done
    later = (
        study.repetitions * len(study.estimators) * len(study.sources) * len(jobs.KEYPOINT_CONTROLS)
    )
    step, run_frames = _odometry(
        "odometry",
        study.first_jobs(),
        later if study.tested else 0,
        study.opened,
        study.sources,
        folder / "runs",
    )
    return _plan([step], study.opened, run_frames * ROW_BYTES, STUDY_SECONDS)


def of_thesis(root: Path, sizes: Profile, folder: Path) -> dict[str, Any]:
    """Return the plan of the notebooks on a KITTI folder with the model in the package, see
    `_plan`.

    folder: build folder of the run. Its finished runs of the odometry are not planned again.
    Raises InputError if no sequence is long enough to be timed.
    """
    from thesis_repro.segmentation import quietly

    with quietly():
        # imported here because TensorFlow takes seconds to load
        from thesis_repro.segmentation import prediction

    sequences = [kitti.Sequence(root, name).subset(sizes.frames) for name in kitti.sequences(root)]
    timed, total = _longest(sequences), sum(map(len, sequences))
    timed_frames = sum(min(len(sequence), sizes.timed_frames) for sequence in sequences)
    model = prediction.load_shipped()
    planned = jobs.first_jobs(
        sequences,
        {"thesis": sizes.widths, "refined": []},
        tested=jobs.CONTROL_WIDTH,
        repetitions=sizes.repetitions,
    )
    # the reduced run and the keypoint controls are planned when the masked runs are done
    later = (1 + len(jobs.KEYPOINT_CONTROLS) * len(jobs.ESTIMATORS)) * sizes.repetitions

    def predict(count: int, folder: Path) -> None:
        prediction.write_label_maps(model, timed.subset(count).frame_paths, folder / timed.name)

    with TemporaryDirectory() as labels:
        predict(LONG, Path(labels))
        _, label_map = _seconds(predict)
        odometry_step, run_frames = _odometry(
            "08: odometry",
            planned,
            later,
            sequences,
            [Source(Path(labels))],
            folder / "odometry",
        )
        _, one_run = _seconds(lambda count, _: odometry.run(timed.subset(count)))
        _, all_ablations = _seconds(
            lambda count, folder: ablations.measure([timed.subset(count)], Path(labels), folder)
        )
    in_07 = min(map(len, sequences))
    steps = [
        ("05: label maps", total, "frames", total * label_map),
        ("07: one sequence", in_07, "frames", in_07 * RUNS_IN_07 * one_run),
        odometry_step,
        (
            "08: timing of every width",
            timed_frames,
            "frames",
            timed_frames * (len(sizes.widths) + 1) * one_run,
        ),
        ("09: ablations", total, "frames", total * all_ablations),
    ]
    return _plan(
        steps, sequences, total * LABEL_MAP_BYTES + run_frames * ROW_BYTES, 6 * NOTEBOOK_SECONDS
    )


def _odometry(
    name: str,
    planned: list[jobs.Job],
    later: int,
    sequences: list[kitti.Sequence],
    sources: Iterable[Source],
    folder: Path,
) -> tuple[tuple[str, int, str, float], int]:
    """Return the step (see `_plan`) of the runs without a result in a folder, and their frames.

    later: number of further runs of each sequence, such as controls whose settings follow from
    other runs. The runs of the longest sequence are timed together, because they share work.
    """
    timed = _longest(sequences)
    timed_jobs = [job for job in planned if job.sequence == timed.name]
    times = _seconds(
        lambda count, results: runner.run(timed_jobs, [timed.subset(count)], sources, results)
    )
    start, frame = np.array(times) / len(timed_jobs)
    seconds, runs, run_frames = 0.0, 0, 0
    later_methods = ("reduced", *jobs.KEYPOINT_CONTROLS)  # names of results begin with the method
    for sequence in sequences:
        left = sum(
            not runner.result_file(folder, job).is_file()
            for job in planned
            if job.sequence == sequence.name
        )
        made = (folder / sequence.name).rglob("*.csv")
        left += max(0, later - sum(path.name.startswith(later_methods) for path in made))
        runs, run_frames = runs + left, run_frames + left * len(sequence)
        seconds += left * (start + len(sequence) * frame)
    return (name, runs, "runs", seconds), run_frames


def _plan(
    steps: list[tuple[str, int, str, float]],
    sequences: list[kitti.Sequence],
    disk: float,
    once: float = 0,
) -> dict[str, Any]:
    """Return a plan as a record for the template plan.txt.j2.

    steps: (name, number, unit, seconds on one core). disk: bytes. once: seconds that more cores do
    not shorten.
    """
    seconds = sum(step[-1] for step in steps)
    return {
        "steps": steps,
        "once": once,
        "seconds": once + seconds,
        "cores": cores(),
        "on_all_cores": once + seconds / cores(),
        "sequences": len(sequences),
        "frames": sum(map(len, sequences)),
        "timed": _longest(sequences).name,
        "timed_frames": LONG,
        "disk": disk,
        "fewest": compare.MIN_SEQUENCES,
    }


def _longest(sequences: list[kitti.Sequence]) -> kitti.Sequence:
    """Return the longest sequence, whose first frames are timed."""
    longest = max(sequences, key=len)
    if len(longest) < LONG:
        raise InputError(
            f"the sequences are too short to plan from; one of {LONG} frames or more is needed"
        )
    return longest


def _seconds(run: Callable[[int, Path], Any]) -> tuple[float, float]:
    """Return the CPU seconds of run(frames, folder): of its start, and of each frame."""
    seconds = []
    for count in (SHORT, SHORT, LONG):  # the first run loads compiled code
        with (
            TemporaryDirectory() as folder,
            redirect_stdout(StringIO()),
            redirect_stderr(StringIO()),
        ):
            started = time.process_time()
            run(count, Path(folder))
            seconds.append(time.process_time() - started)
    frame = max(seconds[2] - seconds[1], 0) / (LONG - SHORT)
    return max(seconds[1] - SHORT * frame, 0), frame
