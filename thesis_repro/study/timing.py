"""How long things take: every dilation width as the thesis times it (Figure 4.17), and a whole frame.

A whole frame goes from its file to its pose with the network included, which Section 5.2.2 asks for. It is timed as in
a live system: one frame after the other, the network on one image at a time, all cores.
"""

import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import joblib
import numpy as np
import pandas as pd

from thesis_repro import InputError, masks, odometry, stages
from thesis_repro.files import progress, write_text
from thesis_repro.kitti import Sequence
from thesis_repro.study.jobs import CONTROL_WIDTH, Job
from thesis_repro.study.runner import by_name, masks_of
from thesis_repro.study.sources import Source

STAGES = ("read", "segmentation", "mask", "detection", "tracking", "pose")
PLAIN = "all keypoints"  # the method without network and mask; the other is "masked, width 10" or whatever width
WARM_UP = 3  # frames that load compiled code and fill caches, not counted


@contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """Use `count` threads inside OpenCV's functions in this context; -1 for one a core."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


# Every width, without the network


def time_runs(jobs: Iterable[Job], kitti: Path, labels: Path | Iterable[Source], folder: Path, *, frames: int,
              processes: int = 1) -> pd.DataFrame:
    """How long each job takes as a run of its own: a table of sequence, run, method, dilation_width and seconds.

    Only the first `frames` frames are timed; the first two steps are left out, since they load compiled code. The jobs
    of a sequence take turns at every frame, so that what else the machine does falls on all of them alike.
    To be called after `runner.run`, whose folder and whose label maps it shares. Raises InputError where there are no
    runs.
    """
    jobs, sources = list(jobs), by_name(labels)
    files = {name: folder / name / f"seconds-{frames}.csv" for name in sorted({job.sequence for job in jobs})}
    waiting = {name: [job for job in jobs if job.sequence == name] for name in files}
    waiting = {name: of_name for name, of_name in waiting.items() if not files[name].is_file()
               or not {job.name for job in of_name} <= set(pd.read_csv(files[name])["run"])}
    for name in waiting:
        if stages.record(folder / name) is None:
            raise InputError(f"{folder / name}: holds no odometry runs; they are timed after runner.run has made them")
    work = joblib.Parallel(n_jobs=processes, return_as="generator_unordered")(
        joblib.delayed(_time_jobs)(of_name, Sequence(kitti, name).subset(frames), sources, files[name])
        for name, of_name in waiting.items())
    for _ in progress(work, "timing", total=len(waiting), unit="sequence"):
        pass
    return pd.concat([pd.read_csv(path, dtype={"sequence": str}) for path in files.values()], ignore_index=True)


def _time_jobs(jobs: list[Job], sequence: Sequence, sources: dict[str, Source], path: Path) -> None:
    scales = odometry.scales(sequence)
    masks_by_job, _ = masks_of(jobs, sequence, sources)
    followers = {job: odometry.Odometry(sequence.intrinsics, job.settings) for job in masks_by_job}
    seconds = dict.fromkeys(masks_by_job, 0.0)
    with opencv_threads(1):  # one thread makes times comparable
        for index in range(len(sequence)):
            frame = sequence.frame(index)
            for job, follower in followers.items():
                masks.forget_edges()  # each run of its own would have to make them
                its_masks = masks_by_job[job]
                mask, masking = (None, 0.0) if its_masks is None else _timed(its_masks.__getitem__, index)
                step = follower.step(frame, scales[index], mask)
                if index > 1:
                    # Section 4.2 counts what happens from frame to frame and the making of the mask, not the prediction
                    seconds[job] += masking + sum(step.seconds.values())
    table = pd.DataFrame([{"sequence": job.sequence, "run": job.name, "method": job.method,
                           "dilation_width": job.dilation_width, "seconds": value} for job, value in seconds.items()],
                         columns=["sequence", "run", "method", "dilation_width", "seconds"])
    write_text(path, table.to_csv(index=False))


# A whole frame, with the network


def measure(sequence: Sequence, model: Any, *, frames: int = 20, width: int = CONTROL_WIDTH,
            boundaries: str = "canny") -> pd.DataFrame:
    """Milliseconds a frame of every stage: a table of method, stage and milliseconds, medians over `frames` frames.

    Methods: "all keypoints", without network and mask, and "masked, width 10". Stages: read (decode the PNG),
    segmentation (stretch to the model's input, network, class of every pixel), mask (label map to 320x320, edges,
    dilation), detection, tracking, pose (essential matrix, then rotation and translation).
    model: a Keras model of `segmentation`. width: pixels, and boundaries, see `masks.edges`, of the masks.
    The methods take turns at every frame. Raises InputError for a sequence with too few frames.
    """
    sequence, metres = _start(sequence, frames)
    masked = _masked(width)
    runs = {name: odometry.Odometry(sequence.intrinsics) for name in (PLAIN, masked)}
    rows = []
    with opencv_threads(-1):
        for index in progress(range(len(sequence)), "timing"):
            frame, read = _timed(sequence.frame, index)
            label_map, network = _timed(_segment, model, frame)
            mask, masking = _timed(_mask, label_map, frame.shape, width, boundaries)
            for name, run in runs.items():
                seconds = run.step(frame, metres[index], mask if name == masked else None).seconds
                before = {"read": read, **({"segmentation": network, "mask": masking} if name == masked else {})}
                if index >= WARM_UP:
                    rows.append({"method": name, **before, "detection": seconds["detect"],
                                 "tracking": seconds["track"], "pose": seconds["essential"] + seconds["pose"]})
    medians = 1000 * pd.DataFrame(rows).groupby("method", sort=False)[list(STAGES)].median()
    return medians.melt(ignore_index=False, var_name="stage", value_name="milliseconds").dropna().reset_index()


def measure_overlapped(sequence: Sequence, model: Any, *, frames: int = 20, width: int = CONTROL_WIDTH,
                       boundaries: str = "canny") -> pd.DataFrame:
    """Milliseconds between frames where reading, network and mask of the next frame go on beside the odometry of this.

    A table of method and milliseconds (medians). A frame's own way takes as long as before or longer; more frames a
    second come through. Methods and arguments as in `measure`.
    """
    sequence, metres = _start(sequence, frames)
    rows = []
    with opencv_threads(-1), ThreadPoolExecutor(1) as pool:
        for name in (PLAIN, _masked(width)):

            def front(index: int, plain: bool = name == PLAIN) -> tuple[np.ndarray, np.ndarray | None]:
                frame = sequence.frame(index)
                return frame, None if plain else _mask(_segment(model, frame), frame.shape, width, boundaries)

            run, times = odometry.Odometry(sequence.intrinsics), []
            waiting = pool.submit(front, 0)
            for index in range(len(sequence)):
                frame, mask = waiting.result()
                if index + 1 < len(sequence):
                    waiting = pool.submit(front, index + 1)
                run.step(frame, metres[index], mask)
                times.append(time.perf_counter())
            rows.append({"method": name, "milliseconds": 1000 * pd.Series(times).diff()[WARM_UP:].median()})
    return pd.DataFrame(rows)


def frame_times(folder: Path, sequence: Sequence, model_file: Path, *, frames: int = 20, width: int = CONTROL_WIDTH,
         boundaries: str = "canny") -> tuple[pd.DataFrame, pd.DataFrame]:
    """(`measure`, `measure_overlapped`) of the first frames with the model in a file.

    The folder keeps both tables. They are measured anew when the frames, the masks, the model or the code change.
    """
    short = sequence.subset(frames + WARM_UP)
    folder = stages.stage(folder, code=stages.code("study/timing"),
                          model=stages.content(model_file), opencv=cv2.__version__,
                          frames=stages.listing(short.frame_paths), width=width, boundaries=boundaries)
    files = {folder / "budget.csv": measure, folder / "overlapped.csv": measure_overlapped}
    missing = {path: function for path, function in files.items() if not path.is_file()}
    if missing:
        from thesis_repro.segmentation import training  # here and below: TensorFlow takes seconds to load

        model = training.load_model(model_file)
    for path, function in missing.items():
        write_text(path, function(short, model, frames=frames, width=width, boundaries=boundaries).to_csv(index=False))
    measured, overlapped = (pd.read_csv(path) for path in files)
    return measured, overlapped


def recorded(measured: pd.DataFrame, path: Path, keep: bool) -> pd.DataFrame:
    """The timings to draw: `measured`, which is written to a file; with `keep` those that the file already has.

    Figures in git keep the timings that came with them. Otherwise every machine and every run would change them.
    """
    if not (keep and path.is_file()):
        write_text(path, measured.to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def _masked(width: int) -> str:
    return f"masked, width {width}"


def _start(sequence: Sequence, frames: int) -> tuple[Sequence, np.ndarray]:
    sequence = sequence.subset(frames + WARM_UP)
    if len(sequence) < WARM_UP + 2:
        raise InputError(f"sequence {sequence.name}: {len(sequence)} frames; timing needs {WARM_UP + 2} or more")
    return sequence, odometry.scales(sequence)


def _timed(work: Callable, *arguments: Any) -> tuple[Any, float]:
    started = time.perf_counter()
    result = work(*arguments)
    return result, time.perf_counter() - started


def _segment(model: Any, frame: np.ndarray) -> np.ndarray:
    from thesis_repro.segmentation import prediction

    _, height, width, channels = model.input_shape
    if channels == 3:
        frame = cv2.cvtColor(frame, cv2.COLOR_GRAY2RGB)
    image = cv2.resize(frame, (width, height)).reshape(height, width, channels)
    return prediction.predict(model, image[None])[0]


def _mask(label_map: np.ndarray, size: tuple[int, int], width: int, boundaries: str) -> np.ndarray:
    from thesis_repro.segmentation import prediction

    # the same as from a written label map, whose size is the thesis's whatever the model's is
    label_map = cv2.resize(label_map, (prediction.SIZE,) * 2, interpolation=cv2.INTER_NEAREST)
    return masks.keypoint_mask(label_map, size, width, boundaries)
