"""What a frame costs from its file to its pose, the network included, as Section 5.2 asks.

Everything is done as a live system would: one frame after the other, the network on one image at a time, all cores.
"""

import time
from concurrent.futures import ThreadPoolExecutor

import cv2
import pandas as pd

from thesis_repro import InputError, masks, odometry, segmentation, stages, training
from thesis_repro.bench import opencv_threads
from thesis_repro.experiments import CONTROL_WIDTH as WIDTH
from thesis_repro.files import progress, write_text

STAGES = ("read", "segmentation", "mask", "detection", "tracking", "pose")
WARM_UP = 3  # frames that load compiled code and fill caches, not counted
CODE = ("bench", "budget", "cityscapes", "files", "five_point", "keypoints", "masks", "odometry", "pose", "ransac",
        "segmentation")


def measure(sequence, model, *, frames=20, width=WIDTH, settings=odometry.THESIS):
    """Milliseconds a frame of every stage: a table of variant, stage and milliseconds, medians over `frames` frames.

    Variants: "all keypoints", without network and mask, and "masked, width W". Stages: read (decode the PNG),
    segmentation (stretch to the model's input, network, class of every pixel), mask (label map to 320x320, edges,
    dilation), detection, tracking, pose (essential matrix, then rotation and translation).
    model: a Keras model of `segmentation`. The variants take turns at every frame.
    Raises InputError for a sequence with too few frames.
    """
    sequence, metres = _start(sequence, frames)
    plain, masked = _names(width)
    runs = {name: odometry.Odometry(sequence.intrinsics, settings) for name in (plain, masked)}
    rows = []
    with opencv_threads(-1):
        for index in progress(range(len(sequence)), "budget"):
            frame, read = _timed(sequence.frame, index)
            label_map, network = _timed(_segment, model, frame)
            mask, masking = _timed(_mask, label_map, frame.shape, width)
            for name, run in runs.items():
                seconds = run.step(frame, metres[index], mask if name == masked else None).seconds
                before = {"read": read, **({"segmentation": network, "mask": masking} if name == masked else {})}
                if index >= WARM_UP:
                    rows.append({"variant": name, **before, "detection": seconds["detect"],
                                 "tracking": seconds["track"], "pose": seconds["essential"] + seconds["pose"]})
    medians = 1000 * pd.DataFrame(rows).groupby("variant", sort=False)[list(STAGES)].median()
    return medians.melt(ignore_index=False, var_name="stage", value_name="milliseconds").dropna().reset_index()


def measure_overlapped(sequence, model, *, frames=20, width=WIDTH, settings=odometry.THESIS):
    """Milliseconds between frames where reading, network and mask of the next frame go on beside the odometry of this.

    A table of variant and milliseconds (medians). A frame's own way takes as long as before or longer; more frames a
    second come through. Variants and arguments as in `measure`.
    """
    sequence, metres = _start(sequence, frames)
    rows = []
    with opencv_threads(-1), ThreadPoolExecutor(1) as pool:
        for name in _names(width):
            is_masked = name != _names(width)[0]

            def front(index, is_masked=is_masked):
                frame = sequence.frame(index)
                return frame, _mask(_segment(model, frame), frame.shape, width) if is_masked else None

            run, times = odometry.Odometry(sequence.intrinsics, settings), []
            waiting = pool.submit(front, 0)
            for index in range(len(sequence)):
                frame, mask = waiting.result()
                if index + 1 < len(sequence):
                    waiting = pool.submit(front, index + 1)
                run.step(frame, metres[index], mask)
                times.append(time.perf_counter())
            rows.append({"variant": name, "milliseconds": 1000 * pd.Series(times).diff()[WARM_UP:].median()})
    return pd.DataFrame(rows)


def kept(folder, sequence, model_file, *, frames=20):
    """(`measure`, `measure_overlapped`) of the first frames with the model in a file, measured once and kept in folder.

    Measured anew when the frames, the model or the code become others.
    """
    short = sequence.subset(frames + WARM_UP)
    folder = stages.stage(folder, code=stages.code(*CODE), model=stages.content(model_file), opencv=cv2.__version__,
                          frames=stages.listing(short.frame_paths))
    files = {folder / "budget.csv": measure, folder / "overlapped.csv": measure_overlapped}
    missing = {path: function for path, function in files.items() if not path.is_file()}
    model = training.load_model(model_file) if missing else None
    for path, function in missing.items():
        write_text(path, function(short, model, frames=frames).to_csv(index=False))
    return tuple(pd.read_csv(path) for path in files)


def _start(sequence, frames):
    sequence = sequence.subset(frames + WARM_UP)
    if len(sequence) < WARM_UP + 2:
        raise InputError(f"sequence {sequence.name}: {len(sequence)} frames; the budget needs {WARM_UP + 2} or more")
    return sequence, odometry.scales(sequence)


def _names(width):
    return "all keypoints", f"masked, width {width}"


def _timed(work, *arguments):
    started = time.perf_counter()
    result = work(*arguments)
    return result, time.perf_counter() - started


def _segment(model, frame):
    _, height, width, channels = model.input_shape
    if channels == 3:
        frame = cv2.cvtColor(frame, cv2.COLOR_GRAY2RGB)
    image = cv2.resize(frame, (width, height)).reshape(height, width, channels)
    return segmentation.predict(model, image[None])[0]


def _mask(label_map, size, width):
    # the same as from a written label map, whose size is the thesis's whatever the model's is
    label_map = cv2.resize(label_map, (segmentation.SIZE,) * 2, interpolation=cv2.INTER_NEAREST)
    return masks.keypoint_mask(label_map, size, width)
