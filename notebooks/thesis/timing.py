"""Time a run for each dilation width, and each stage from a frame's file to its pose.

The widths are timed as in the thesis (Figure 4.17). The stages include the network, as Section
5.2.2 asks for. They are timed as in a live system: one frame after the other, the network on one
image at a time, all cores.
"""

import platform
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd

from keypoint_study.best_width import percent_change
from keypoint_study.jobs import CONTROL_WIDTH
from thesis.settings import Settings, cores
from thesis_repro import masks, odometry
from thesis_repro.data.cityscapes import resize_bilinear
from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import folders
from thesis_repro.odometry.runs import Masks
from thesis_repro.running.files import progress, write_text

TURNS = 2  # of each run, of which the fastest counts
FRAMES = 20  # on which the stages are timed
WARM_UP = 3  # frames before them, which load compiled code and fill caches


def seconds_of(sequence: Sequence, masks: Masks | None = None) -> float:
    """Return the seconds that the odometry and its masks take in a run of its own, on one thread.

    The runs of `keypoint_study.runner` share work, so none of them can be timed. The first two
    steps load code and are not counted; nor are frames' files and the network, as in Section 4.2.
    """
    cv2.setNumThreads(1)
    seconds = []
    for _ in range(TURNS):
        folders.forget_edges()  # which the run before has found
        frames = odometry.run(sequence, masks=masks).frames
        seconds.append(frames.filter(like="_seconds")[2:].to_numpy().sum())
    cv2.setNumThreads(-1)  # as many as there are cores
    return min(seconds)


def time_savings(seconds: pd.DataFrame) -> pd.Series:
    """Return the change of time (%) from all keypoints for each dilation width (Equation 4.2).

    It is negative if time is saved. seconds: one row a run, with sequence, method ("baseline" or
    "masked"), dilation_width and seconds, which are added over the sequences.
    """
    baseline = seconds.loc[seconds["method"] == "baseline", "seconds"].sum()
    masked = seconds[seconds["method"] == "masked"]
    return percent_change(masked.groupby("dilation_width")["seconds"].sum(), baseline)


def time_stages(
    sequence: Sequence, model: Any, width: int = CONTROL_WIDTH, frames: int = FRAMES
) -> pd.DataFrame:
    """Time each stage of a frame, with all keypoints and with masks.

    Returns a table of method, stage, milliseconds (medians).
    Stages: read (the frame's file), segmentation (resize to the model's input, network, class of
    every pixel), mask (label map to 320x320, edges, dilation), detection, tracking, pose (essential
    matrix, then rotation and translation). model: a Keras model of `segmentation`. width: of the
    masks, pixels. frames: number of those that are timed.
    """
    from thesis_repro.segmentation import prediction  # TensorFlow takes seconds to load

    sequence = sequence.subset(WARM_UP + frames)
    height, columns, channels = model.input_shape[1:]
    seconds, made = [], []
    for index in progress(range(len(sequence)), "timing"):
        times = [time.perf_counter()]
        frame = sequence.frame(index)
        times.append(time.perf_counter())
        image = resize_bilinear(frame, (height, columns))[..., None].repeat(channels, axis=2)
        label_map = prediction.predict(model, image[None])[0]
        times.append(time.perf_counter())
        small = (prediction.SIZE,) * 2  # in which label maps are written
        label_map = cv2.resize(label_map, small, interpolation=cv2.INTER_NEAREST)
        made.append(masks.keypoint_mask(label_map, frame.shape, width))
        times.append(time.perf_counter())
        seconds.append(np.diff(times))
    stages = pd.DataFrame(seconds, columns=["read", "segmentation", "mask"])
    medians = {}
    for method, frame_masks in {"all keypoints": None, f"masked, width {width}": made}.items():
        steps = odometry.run(sequence, masks=frame_masks).frames
        table = stages.assign(
            detection=steps["detect_seconds"],
            tracking=steps["track_seconds"],
            pose=steps["essential_seconds"] + steps["pose_seconds"],
        )
        medians[method] = 1000 * table[WARM_UP:].median()
    medians["all keypoints"][["segmentation", "mask"]] = np.nan
    by_stage = pd.DataFrame(medians).stack().dropna().rename_axis(["stage", "method"])
    return by_stage.rename("milliseconds").reset_index()[["method", "stage", "milliseconds"]]


def recorded(settings: Settings, name: str, measured: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return the timings that are drawn, with a column for the processor.

    They are those measured now, which are kept in a file, or those of this file if none are given.
    Figures in git keep their timings, which would otherwise change with every machine and every
    run.
    """
    folder = settings.published if settings.figures_in_git else settings.figures
    path = folder / "timings" / f"{name}.csv"
    if measured is not None and not (settings.figures_in_git and path.is_file()):
        write_text(path, measured.assign(processor=processor()).to_csv(index=False))
    return pd.read_csv(path, dtype={"sequence": str})


def processor() -> str:
    """Return the name of this machine's processor, and its number of cores in use."""
    name = platform.processor() or platform.machine()
    with suppress(OSError, StopIteration):  # on Linux these are only "x86_64"
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.split(": ", 1)[1] for line in lines if line.startswith("model name"))
    return f"{name}, {cores()} cores"
