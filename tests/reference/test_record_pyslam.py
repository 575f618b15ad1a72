"""The recorder of PySLAM's runs, with stand-ins for PySLAM's modules that call OpenCV alike."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
from trials import succeed

from thesis import real_frames
from thesis_repro import odometry
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks.folders import LabelMasks, MaskFolder
from thesis_repro.running.files import write_png

RECORDER = Path(__file__).with_name("record_pyslam.py")
COUNTS = {"points": "n_kps_to_lk", "detected": "n_detected", "tracked": "n_tracked"}
COUNTS |= {"inliers": "n_inliers_E", "pose_inliers": "n_inliers_recoverPose"}
STAND_INS = {
    "camera": """
import numpy as np
class PinholeCamera:
    def __init__(self, width, height, fx, fy, cx, cy, distortion, fps):
        self.inverse = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
""",
    "feature_tracker_configs": """
class FeatureTrackerConfigs:
    LK_SHI_TOMASI = {"num_features": 0}
""",
    "feature_tracker": """
import cv2
import numpy as np
from types import SimpleNamespace
class Tracker:
    def __init__(self, num_features):
        self.num_features = num_features
    def detectAndCompute(self, frame, mask=None):
        points = cv2.goodFeaturesToTrack(frame, self.num_features, 0.01, 3, blockSize=5, mask=mask)
        return points[:, 0], None
    def track(self, before, now, points, descriptors):
        new, status, _ = cv2.calcOpticalFlowPyrLK(
            before, now, points, None, winSize=(21, 21), maxLevel=3, criteria=(3, 30, 0.01))
        kept = status[:, 0] == 1
        return SimpleNamespace(kps_ref_matched=points[kept], kps_cur_matched=new[kept])
feature_tracker_factory = Tracker
""",
    "ground_truth": """
import numpy as np
class Truth:
    def __init__(self, settings):
        rows = np.loadtxt(f"{settings['base_path']}/poses/{settings['name']}.txt")
        self.positions = rows[:, [3, 7, 11]]
    def getPoseAndAbsoluteScale(self, index):
        step = self.positions[index] - self.positions[index - 1]
        return *self.positions[index], np.sqrt(np.sum(step**2))
groundtruth_factory = Truth
""",
    "visual_odometry": """
import cv2
import numpy as np
class VisualOdometry:
    def __init__(self, camera, truth, tracker):
        self.camera, self.truth, self.tracker = camera, truth, tracker
        self.cur_R, self.cur_t, self.before = np.eye(3), np.zeros((3, 1)), None
    def drawFeatureTracks(self, image):
        raise RuntimeError("there is no display")
    def track(self, image, index):
        if self.before is not None:
            found = self.tracker.track(self.before, image, self.points, None)
            pairs = found.kps_cur_matched, found.kps_ref_matched
            new, old = (
                (self.camera.inverse @ np.c_[each, np.ones(len(each))].T).T[:, :2] for each in pairs)
            matrix, self.mask_match = cv2.findEssentialMat(
                new, old, focal=1, pp=(0, 0), method=cv2.RANSAC, prob=0.999, threshold=0.0003)
            _, rotation, direction, _ = cv2.recoverPose(matrix, new, old, focal=1, pp=(0, 0))
            scale = self.truth.getPoseAndAbsoluteScale(index)[3]
            if scale > 0.1:
                self.cur_t = self.cur_t + scale * self.cur_R.dot(direction)
                self.cur_R = self.cur_R.dot(rotation)
            self.points = found.kps_cur_matched
        if self.before is None or len(self.points) < self.tracker.num_features:
            self.points, _ = self.tracker.detectAndCompute(image)
        self.drawFeatureTracks(image)
        self.before = image
""",
}


def test_it_writes_poses_and_counts_with_and_without_masks(small_world, small_labels, tmp_path):
    for name, code in STAND_INS.items():
        path = tmp_path / "pyslam" / f"{name}.py"
        path.parent.mkdir(exist_ok=True)
        path.write_text(code)
    drive = real_frames.cut(Sequence(small_world / "kitti", "00"), 0, 5, tmp_path / "cut", "00")
    of_labels = LabelMasks(small_labels / "00", drive, dilation_width=10)
    folder = tmp_path / "masks"
    folder.mkdir()
    for index, name in enumerate(drive.label_names):
        write_png(folder / name, of_labels[index])
    runs = {"all": [], "masked": [folder]}
    for name, masks in runs.items():
        output = tmp_path / f"{name}.csv"
        command = [sys.executable, RECORDER, "pyslam", tmp_path / "cut", "00", output]
        succeed([*command, *masks], tmp_path)
        recorded = pd.read_csv(output)
        given = {"masks": MaskFolder(folder, drive)} if masks else {}
        ours = odometry.run(drive, **given).frames
        for own, theirs in COUNTS.items():
            counts = ours[own].to_numpy(float, na_value=np.nan)
            np.testing.assert_array_equal(counts, recorded[theirs])
        columns = ["x", "y", "z", "r00", "r12", "r22"]
        np.testing.assert_allclose(ours[columns], recorded[columns], rtol=0, atol=1e-9)
        np.testing.assert_array_equal(ours["updated"][1:], recorded["pose_updated"][1:] == 1)
        relative = recorded[["rel_t0", "rel_t1", "rel_t2"]][1:]
        assert np.allclose(np.linalg.norm(relative, axis=1), 1)
    assert recorded["n_detected"].max() < pd.read_csv(tmp_path / "all.csv")["n_detected"].max()
