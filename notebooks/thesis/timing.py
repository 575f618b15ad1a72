"""Time every dilation width, and each stage from a frame's file to its pose.

The widths are timed as in the thesis (Figure 4.17). The stages include the network, as Section
5.2.2 asks for. They are timed as in a live system: one frame after the other, the network on one
image at a time, all cores.
"""

import platform
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from thesis_repro import mask_files, masks, odometry
from thesis_repro.data.cityscapes import resize_bilinear
from thesis_repro.data.kitti import Sequence
from thesis_repro.running.files import needed, progress, write_text
from thesis_repro.running.settings import Settings, cores
from thesis_repro.study import workers
from thesis_repro.study.jobs import CONTROL_WIDTH, Job
from thesis_repro.study.runner import chosen
from thesis_repro.study.sources import Source, by_name

STAGES = ("read", "segmentation", "mask", "detection", "tracking", "pose")
FRAMES = 20  # on which the stages are timed
WARM_UP = 3  # frames before them, which load compiled code and fill caches


@contextmanager
def opencv_threads(count: int) -> Iterator[None]:
    """Use `count` threads in OpenCV's functions inside a with block; -1 for one thread a core."""
    previous_count = cv2.getNumThreads()
    cv2.setNumThreads(count)
    try:
        yield
    finally:
        cv2.setNumThreads(previous_count)


def time_runs(
    jobs: Iterable[Job],
    sequences: Iterable[Sequence],
    labels: Path | Iterable[Source],
    folder: Path,
    *,
    processes: int = 1,
) -> pd.DataFrame:
    """Time each job as a separate run; returns a table with one row a run.

    Its columns are sequence, run, method, dilation_width and seconds. The first two steps are not
    timed, because they load compiled code. The jobs of a sequence take turns at every frame, so
    that other programs slow all of them equally. Call it after `runner.run_jobs`, with the same
    folder and label maps. Times in the folder are not measured again.
    """
    jobs, sources = list(jobs), by_name(labels)
    calls = []
    for sequence in sequences:
        sequence_jobs = [job for job in jobs if job.sequence == sequence.name]
        path = folder / sequence.name / f"seconds-{len(sequence)}.csv"
        calls.append((sequence_jobs, sequence, sources, path))
    with workers.open_pool(processes) as pool:
        timed = pool.run(_time_jobs, calls)
        tables = list(progress(timed, "timing", total=len(calls), unit="sequence"))
    return pd.concat(tables, ignore_index=True)


def _time_jobs(
    jobs: list[Job], sequence: Sequence, sources: dict[str, Source], path: Path
) -> pd.DataFrame:
    if path.is_file():
        earlier = pd.read_csv(path, dtype={"sequence": str})
        if {job.name for job in jobs} <= set(earlier["run"]):
            return earlier
    scales = odometry.scales(sequence)
    runs, _ = chosen(jobs, {sequence.name: sequence}, sources)
    odometries = {
        job: odometry.Odometry(sequence.intrinsics, settings)
        for job, (_, settings, _) in runs.items()
    }
    seconds = dict.fromkeys(runs, 0.0)
    with opencv_threads(1):  # one thread makes times comparable
        for index in range(len(sequence)):
            frame = sequence.frame(index)
            for job, (_, _, job_masks) in runs.items():
                mask_files.forget_edges()  # a separate run would have to find them
                mask, mask_seconds = None, 0.0
                if job_masks is not None:
                    mask, mask_seconds = _timed(job_masks.__getitem__, index)
                step = odometries[job].step(frame, scales[index], mask)
                if index > 1:
                    # Section 4.2 counts the odometry and the masks; the network is not counted
                    seconds[job] += mask_seconds + sum(step.seconds.values())
    rows = [
        {
            "sequence": job.sequence,
            "run": job.name,
            "method": job.method,
            "dilation_width": job.dilation_width,
            "seconds": round(job_seconds, 4),
        }
        for job, job_seconds in seconds.items()
    ]
    write_text(path, pd.DataFrame(rows).to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def measure(sequence: Sequence, model: Any, width: int = CONTROL_WIDTH) -> pd.DataFrame:
    """Time each stage of a frame, with all keypoints and with masks.

    Returns a table of method, stage, milliseconds (medians).
    Stages: read (the frame's file), segmentation (resize to the model's input, network, class of
    every pixel), mask (label map to 320x320, edges, dilation), detection, tracking, pose (essential
    matrix, then rotation and translation). model: a Keras model of `segmentation`. width: of the
    masks, pixels. The methods take turns.
    """
    sequence = sequence.subset(FRAMES + WARM_UP)
    scales = odometry.scales(sequence)
    methods = "all keypoints", f"masked, width {width}"
    odometries = {method: odometry.Odometry(sequence.intrinsics) for method in methods}
    rows: list[dict[str, Any]] = []
    with opencv_threads(-1):
        for index in progress(range(len(sequence)), "timing"):
            frame, read = _timed(sequence.frame, index)
            label_map, segmentation = _timed(_segment, model, frame)
            mask, masking = _timed(_mask, label_map, frame.shape, width)
            network = {"segmentation": segmentation, "mask": masking}
            for method, method_mask, stages in zip(methods, (None, mask), ({}, network)):
                step = odometries[method].step(frame, scales[index], method_mask)
                if index >= WARM_UP:
                    rows.append({"method": method, "read": read, **stages, **_stages_of(step)})
    by_method = pd.DataFrame(rows).groupby("method", sort=False)
    medians = 1000 * by_method[list(STAGES)].median()
    table = medians.melt(ignore_index=False, var_name="stage", value_name="milliseconds")
    return table.dropna().reset_index()


def used_model(settings: Settings) -> Any:
    """Load the model that made the label maps of a run, chosen as in notebook 5."""
    from thesis_repro.segmentation import quietly

    with quietly():
        from thesis_repro.segmentation import prediction, training
    if settings.uses_shipped_model:
        return training.load_model(prediction.SHIPPED)
    return training.load_model(needed(settings.build / "model" / "model.keras", "04_training"))


def _stages_of(step: odometry.Step) -> dict[str, float]:
    """Return the seconds of the stages that a step of the odometry has."""
    return {
        "detection": step.seconds["detect"],
        "tracking": step.seconds["track"],
        "pose": step.seconds["essential"] + step.seconds["pose"],
    }


def folder(settings: Settings) -> Path:
    """Return the folder of the timings that are drawn.

    For the figures in git it holds those that were recorded on one machine, else those of the run.
    """
    if settings.figures_in_git:
        return settings.published / "timings"
    return settings.figures / "timings"


def recorded(settings: Settings, name: str, measured: pd.DataFrame) -> pd.DataFrame:
    """Write measured timings into `folder` and return them, with a column for the processor.

    Figures in git keep their timings, which would otherwise change with every machine and every
    run: then the timings of the existing file are returned.
    """
    path = folder(settings) / f"{name}.csv"
    if not (settings.figures_in_git and path.is_file()):
        write_text(path, measured.assign(processor=processor()).to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def processor() -> str:
    """Return the name of this machine's processor, and its number of cores in use."""
    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):  # on Linux these are only "x86_64"
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(": ", 1)[1] for line in lines if line.startswith("model name"))
    return f"{name}, {cores()} cores"


def _timed(function: Callable, *arguments: Any) -> tuple[Any, float]:
    started = time.perf_counter()
    result = function(*arguments)
    return result, time.perf_counter() - started


def _segment(model: Any, frame: np.ndarray) -> np.ndarray:
    from thesis_repro.segmentation import prediction

    _, height, width, channels = model.input_shape
    if channels == 3:
        frame = cv2.cvtColor(frame, cv2.COLOR_GRAY2RGB)
    image = resize_bilinear(frame, (height, width)).reshape(height, width, channels)
    return prediction.predict(model, image[None])[0]


def _mask(label_map: np.ndarray, size: tuple[int, int], width: int) -> np.ndarray:
    from thesis_repro.segmentation import prediction

    # label maps are written in the thesis's size, whatever the size of the model's output
    label_map = cv2.resize(label_map, (prediction.SIZE,) * 2, interpolation=cv2.INTER_NEAREST)
    return masks.keypoint_mask(label_map, size, width)
