"""Record a run of PySLAM itself, to compare the odometry with: a table with one row a frame.

Usage, where PySLAM runs: python record_pyslam.py PYSLAM KITTI SEQUENCE OUTPUT.csv [MASKS]

PYSLAM: its checkout, at commit a87ee17 (7 August 2021), the last before 2023 that changes its
visual odometry. KITTI: a folder in the layout of KITTI's odometry benchmark. MASKS: a folder with
one PNG a frame, 255 where keypoints may lie. PySLAM's classes run as they are. Its detector is
called with the mask, no picture is drawn, and what OpenCV's `recoverPose` returns is written down.
The table has no column of an image. This file needs OpenCV and NumPy, and no other of this project.
"""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np

ROTATION = [f"r{row}{column}" for row in range(3) for column in range(3)]
COLUMNS = [
    "frame",
    "n_kps_to_lk",  # points that are given to the tracker
    "n_tracked",
    "n_inliers_E",  # of the essential matrix
    "n_inliers_recoverPose",
    "n_detected",  # empty where PySLAM does not detect
    "gt_scale",  # metres
    "pose_updated",
    *"xyz",  # position of the camera, metres; frame 0 is the origin
    *ROTATION,  # camera to world
    *(f"rel_{name}" for name in ROTATION),  # as recoverPose returns them
    *("rel_t0", "rel_t1", "rel_t2"),
]


class Counting:
    """PySLAM's tracker of features, with a mask for each frame and a note of its counts."""

    def __init__(self, tracker, masks):
        self._tracker, self._masks = tracker, masks
        self.frame, self.row = 0, {}

    def __getattr__(self, name):
        return getattr(self._tracker, name)

    def detectAndCompute(self, frame, mask=None):  # noqa: N802  PySLAM's name
        """Detect keypoints on the mask of the frame."""
        if self._masks:
            mask = cv2.imread(str(self._masks[self.frame]), cv2.IMREAD_GRAYSCALE)
        found = self._tracker.detectAndCompute(frame, mask)
        self.row["n_detected"] = len(found[0])
        return found

    def track(self, before, now, points, descriptors):
        """Track points into a frame."""
        result = self._tracker.track(before, now, points, descriptors)
        self.row |= {"n_kps_to_lk": len(points), "n_tracked": len(result.kps_cur_matched)}
        return result


def record(kitti, sequence, masks=None):
    """Return the rows of a run of PySLAM, whose modules must be found. masks: paths, or None."""
    from camera import PinholeCamera
    from feature_tracker import feature_tracker_factory
    from feature_tracker_configs import FeatureTrackerConfigs
    from ground_truth import groundtruth_factory
    from visual_odometry import VisualOdometry

    class Undrawn(VisualOdometry):
        def drawFeatureTracks(self, image, reinit=False):  # noqa: N802  PySLAM's name
            return image

    folder = Path(kitti) / "sequences" / sequence
    paths = sorted((folder / "image_0").glob("*.png"))
    (line,) = (line for line in (folder / "calib.txt").open() if line.startswith("P0:"))
    fx, _, cx, _, _, fy, cy = map(float, line.split()[1:8])
    height, width = cv2.imread(str(paths[0]), cv2.IMREAD_GRAYSCALE).shape
    camera = PinholeCamera(width, height, fx, fy, cx, cy, [0, 0, 0, 0, 0], 10)
    tracker = Counting(
        feature_tracker_factory(**FeatureTrackerConfigs.LK_SHI_TOMASI | {"num_features": 2000}),
        masks,
    )
    truth = groundtruth_factory({"type": "kitti", "base_path": str(kitti), "name": sequence})
    odometry = Undrawn(camera, truth, tracker)
    returned, recover_pose = [], cv2.recoverPose

    def noted(*arguments, **options):
        returned[:] = recover_pose(*arguments, **options)
        return tuple(returned)

    cv2.recoverPose = noted
    try:
        rows = []
        for index, path in enumerate(paths):
            tracker.frame, tracker.row = index, {"frame": index}
            before = np.array(odometry.cur_t), np.array(odometry.cur_R)
            odometry.track(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE), index)
            row = tracker.row
            if index:
                moved = (odometry.cur_t != before[0]).any() or (odometry.cur_R != before[1]).any()
                row["n_inliers_E"] = int(np.sum(odometry.mask_match))
                row["n_inliers_recoverPose"] = int(returned[0])
                row["gt_scale"] = float(truth.getPoseAndAbsoluteScale(index)[3])
                row["pose_updated"] = int(moved)
                relative = [*np.ravel(returned[1]), *np.ravel(returned[2])]
                row |= dict(zip(COLUMNS[-12:], map(float, relative), strict=True))
            pose = [*np.ravel(odometry.cur_t), *np.ravel(odometry.cur_R)]
            rows.append(row | dict(zip(["x", "y", "z", *ROTATION], map(float, pose), strict=True)))
    finally:
        cv2.recoverPose = recover_pose
    return rows


def main(pyslam, kitti, sequence, output, masks=None):
    """Write the table of a run."""
    sys.path.insert(0, str(Path(pyslam).resolve()))
    rows = record(kitti, sequence, sorted(Path(masks).glob("*.png")) if masks else None)
    with open(output, "w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main(*sys.argv[1:])
