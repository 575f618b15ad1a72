"""How far the errors on drive0009 move if its frames and poses differ in bits, as KITTI's own do.

Usage: python tools/other_bits.py build/excerpts /path/to/raw/2011_09_26

The evidence has frames of drive0009 that were rectified from the raw camera, and poses of camera 2.
KITTI's own frames were rectified by another program, and the raw reader gives poses of camera 0.
That is simulated: each pixel becomes lighter or darker by a gray level, or stays, at random, and
the poses are moved by KITTI's calibration. Label maps are those of the changed frames. Writes
figures/kitti_excerpts/other_bits.csv and .md.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
import pandas as pd

import thesis_repro as tr
from keypoint_study.path_errors import path_errors
from keypoint_study.report import style
from thesis import excerpts
from thesis_repro.data.cityscapes import read_label_map
from thesis_repro.data.trajectories import read_line
from thesis_repro.running import program
from thesis_repro.running.files import progress, write_png
from thesis_repro.segmentation import prediction

STREET, WIDTH, FEW_SPREAD = "drive0009", 10, 200
SEEDS = range(5)  # of the noise
ERROR_TITLES = {"se3": "aligned ATE (m)", "rotation": "rotational RPE, 1 frame (deg)"}
NOTE = "simulated: a gray level of noise in each pixel, five times, and poses of camera 0"


def of_camera_0(poses, day):
    """Return poses (n, 4, 4) of camera 2 as those of camera 0. day: folder of the calibration."""
    projection = read_line(Path(day) / "calib_cam_to_cam.txt", "P_rect_02:", 12).reshape(3, 4)
    offset = np.eye(4)
    offset[:3, 3] = -np.linalg.solve(projection[:, :3], projection[:, 3])
    return offset @ poses @ np.linalg.inv(offset)


def errors_of(frames, camera, poses):
    """Return one row a run: its estimator, keypoints and errors. frames: (n, height, width)."""
    with tempfile.TemporaryDirectory() as name:
        paths = [Path(name) / f"{index:06d}.png" for index in range(len(frames))]
        for path, frame in zip(paths, frames, strict=True):
            write_png(path, frame)
        prediction.write_label_maps(prediction.load_shipped(), paths, Path(name) / "labels")
        maps = [read_label_map(Path(name) / "labels" / path.name) for path in paths]
    masks = [tr.keypoint_mask(each, frames[0].shape, WIDTH) for each in maps]
    runs = {}
    for estimator, options in (("thesis's", {}), ("refined", {"estimator": tr.refined})):
        every = tr.OdometrySettings(**options)
        few = tr.OdometrySettings(detector=tr.spread(FEW_SPREAD), **options)
        runs[estimator, "all keypoints"] = every, None
        runs[estimator, f"masks, width {WIDTH}"] = every, masks
        runs[estimator, f"{FEW_SPREAD} spread keypoints"] = few, None
    sequence = tr.Sequence.from_arrays(frames, camera, poses=poses)
    rows = []
    for (estimator, keypoints), result in tr.run_many(sequence, runs).items():
        errors = path_errors(result.poses, poses)
        row = {"estimator": estimator, "keypoints": keypoints}
        rows.append(row | {name: errors[name] for name in ERROR_TITLES})
    return pd.DataFrame(rows).set_index(["estimator", "keypoints"])


def table_of(evidence, changed):
    """Return the errors of the evidence, and the lowest and highest of changed frames."""
    together = pd.concat(changed).groupby(level=[0, 1], sort=False)
    columns = {}
    for name, title in ERROR_TITLES.items():
        spans = together[name].agg(["min", "max"])
        columns[title] = evidence[name].map("{:.4g}".format)
        columns[f"{title}, other bits"] = [
            f"{low:.4g}-{high:.4g}" for low, high in spans.to_numpy()
        ]
    return pd.DataFrame(columns, index=evidence.index).reset_index()


def main(root, day):
    """Write the table."""
    sequence = tr.Sequence(root, STREET)
    frames = np.array(list(sequence))
    evidence = errors_of(frames, sequence.intrinsics, sequence.poses)
    changed, poses = [], of_camera_0(sequence.poses, day)
    for seed in progress(SEEDS, "noise", unit="run"):
        noise = np.random.default_rng(seed).integers(-1, 2, frames.shape)
        noisy = np.clip(frames + noise, 0, 255).astype(np.uint8)
        changed.append(errors_of(noisy, sequence.intrinsics, poses))
    style.save_table(table_of(evidence, changed), excerpts.FOLDER, "other_bits", NOTE)
    program.summary(f"errors on {STREET} with other bits: {excerpts.FOLDER / 'other_bits.md'}")


if __name__ == "__main__":
    program.run_main(lambda: main(*sys.argv[1:]))
