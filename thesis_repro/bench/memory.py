"""Memory of a long sequence: python -m thesis_repro.bench.memory prints what a process of the odometry takes.

A pass keeps a row of numbers for each frame and run, and nothing else that grows. To see that in minutes, a short
embedded drive is driven to and fro until it has as many frames as asked for, its frames are small, and the estimator,
which keeps nothing, is left out; all else is what a study does: reading, corners, masks, tracking, checkpoints, result
files. A few frames of KITTI's size, with the estimator, show where a process starts from.
"""

import argparse
import contextlib
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from thesis_repro import InputError, kitti, odometry, world
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks
from thesis_repro.odometry import THESIS, Odometry
from thesis_repro.odometry.pose import Motion
from thesis_repro.settings import ALL_WIDTHS
from thesis_repro.study.plan import peak_memory

DRIVE, SHORT, SCALE = "09", 40, 0.2  # the sequence whose first frames are driven to and fro, and their size
FULL_FRAMES = 12  # of KITTI's size
MB = 2**20


def to_and_fro(folder: Path, short: int, frames: int) -> None:
    """Make the `short` frames of the only sequence below a KITTI folder so many, without copies of the pictures."""
    sequence = Sequence(folder, DRIVE)
    way = np.concatenate([np.arange(short), np.arange(short - 2, 0, -1)])
    poses = sequence.poses[np.resize(way, frames)]
    for kind in ("image_0", "labels_0"):
        pictures = sequence.folder / kind
        for index in range(short, frames):
            (pictures / f"{index:06d}.png").symlink_to(f"{way[index % len(way)]:06d}.png")
    (sequence.folder / "times.txt").write_text("".join(f"{0.1 * index:.1f}\n" for index in range(frames)))
    kitti.write_kitti_poses(sequence.poses_path, poses)


def peak(folder: Path, runs: int, estimated: bool) -> tuple[int, int]:
    """Run a pass of so many runs over the only sequence below a KITTI folder: (bytes at the start, most bytes)."""
    sequence = Sequence(folder, DRIVE)
    labels = sequence.folder / "labels_0"
    masks = [None, *(LabelMasks(labels, sequence, width) for width in ALL_WIDTHS)]
    wanted = {f"{index}": (replace(THESIS, estimator="refined" if estimated and index % 2 else "thesis",
                                   shuffle_seed=index // len(masks) or None), masks[index % len(masks)])
              for index in range(runs)}
    with contextlib.ExitStack() as stack:
        if not estimated:
            stack.callback(setattr, Odometry, "estimate", Odometry.estimate)
            Odometry.estimate = _ahead  # type: ignore[method-assign, assignment]
        odometry.run_many(sequence.subset(3), wanted)  # loads all code
        start = peak_memory()
        results = odometry.run_many(sequence, wanted, checkpoint=folder / "pass.npz")
        for name in list(results):
            (folder / f"{name}.csv").write_text(results.pop(name).frames.to_csv(index=False))
    return start, peak_memory()


def _ahead(self: Odometry, step: odometry.Step, essential: object = None) -> None:
    step.motion = Motion(np.eye(3), np.array([0.0, 0.0, 1.0]), np.ones(len(step.current), bool))


def measure(frames: int, runs: int, full_frames: int = FULL_FRAMES) -> dict[str, int]:
    """Bytes: "start" of a process with frames of KITTI's size and so many runs, "grown" over `frames` small ones."""
    if frames < SHORT:
        raise InputError(f"--frames {frames}: must be {SHORT} or more")
    with tempfile.TemporaryDirectory() as temporary, ProcessPoolExecutor(
            1, get_context("spawn"), max_tasks_per_child=1) as pool:
        small, full = Path(temporary, "small"), Path(temporary, "full")
        for folder, count, scale in ((small, SHORT, SCALE), (full, full_frames, 1.0)):
            world.write(folder, sequences=[DRIVE], frames=count, scale=scale, train_images=1, validation_images=1)
        to_and_fro(small / "kitti", SHORT, frames)
        _, start = pool.submit(peak, full / "kitti", runs, True).result()
        before, after = pool.submit(peak, small / "kitti", runs, False).result()
    return {"start": start, "grown": after - before}


def main(arguments=None):
    parser = argparse.ArgumentParser(description="what a process of the odometry takes on a long sequence")
    parser.add_argument("--frames", type=int, default=5000, help="of the long sequence (5000)")
    parser.add_argument("--runs", type=int, default=140, help="that go over it together (140)")
    options = parser.parse_args(arguments)
    try:
        found = measure(options.frames, options.runs)
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    start, grown = found["start"] / MB, found["grown"] / MB
    print(f"{options.runs} runs: {start:.0f} MB with frames of KITTI's size, {grown:.0f} MB more over {options.frames} "
          f"frames, in all {start + grown:.0f} MB a process")
    return 0


if __name__ == "__main__":
    sys.exit(main())
