"""Settings of the odometry: the thesis's, those of a later PySLAM, and alternatives to try."""

import math
from dataclasses import dataclass

from thesis_repro import InputError
from thesis_repro.odometry import pose

CHOICES = {"detector": ("shi-tomasi", "orb"), "mask_mode": ("detect", "filter"),
           "essential_method": tuple(pose.ESSENTIAL_METHODS), "estimator": ("thesis", "inliers", "refined"),
           "alignment": ("position", "pose")}


@dataclass(frozen=True)
class OdometrySettings:
    """What the odometry does; the defaults are the thesis's.

    detector: "shi-tomasi", or "orb" (detection only; points are still tracked).
    max_keypoints: limit of the detector, 0 for none. min_distance: between keypoints, pixels (Shi-Tomasi only).
    quality: of a keypoint, as a share of the strongest one's. block_size: pixels a side in which gradients are summed
    (both Shi-Tomasi only). window, levels: of the tracker, pixels a side and how often the frame is halved.
    mask_mode: "detect" gives the mask to the detector, which fills its quota inside; "filter" drops what lies outside.
    redetect_below: new keypoints replace all points on a frame to which fewer than this were tracked.
    essential_method: how the essential matrix is searched for: "ransac", or OpenCV's "usac", "usac-magsac".
    threshold: of that search, in normalised coordinates.
    shuffle_seed: seed that shuffles the matched points before RANSAC, whose own seed is fixed; None: not shuffled.
    estimator: how the motion follows from the essential matrix. "thesis": all points vote on which of its four motions
    is the right one, as in PySLAM. "inliers": the inliers alone vote (audit rows 13, 29). "refined": RANSAC's motion is
    refitted by least squares to all points near it, the rotation is the smaller of the two possible ones, and a motion
    that no car can make from one frame to the next is searched again (refined.motion_prior).
    fallback: a step whose motion the masked keypoints do not determine, or that differs too much from the step before
    (refined.motion_prior), is estimated from all keypoints. It does nothing without masks.
    scale_gate: metres; a smaller step leaves the pose as it was. shift_gate: the same for the mean shift of the
    points, pixels.
    rotate_first: turn the pose before moving it.
    alignment: how the two paths are laid over each other for RMSE and MAE, see metrics.rmse.
    """

    detector: str = "shi-tomasi"
    max_keypoints: int = 2000
    min_distance: float = 3
    mask_mode: str = "detect"
    redetect_below: int = 2000
    quality: float = 0.01
    block_size: int = 5
    window: int = 21
    levels: int = 3
    essential_method: str = "ransac"
    threshold: float = 0.0003
    shuffle_seed: int | None = None
    estimator: str = "thesis"
    fallback: bool = False
    scale_gate: float = 0.1
    shift_gate: float = 0.0
    rotate_first: bool = False
    alignment: str = "position"

    def __post_init__(self) -> None:
        for name, known in CHOICES.items():
            if getattr(self, name) not in known:
                raise InputError(f"odometry setting {name}: {getattr(self, name)!r} is unknown; "
                                 f"choose one of {', '.join(known)}")
        for name, least, most in (
                ("max_keypoints", 0, 2**31 - 1), ("min_distance", 0, 10_000), ("redetect_below", 0, 2**31 - 1),
                ("quality", 0, 1), ("block_size", 1, 31), ("window", 3, 101), ("levels", 0, 10),
                ("shuffle_seed", 0, 2**32 - 1), ("scale_gate", 0, math.inf), ("shift_gate", 0, math.inf)):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                wrong = f"is above {most}; give less" if value > most else f"is below {least}; give {least} or more"
                raise InputError(f"odometry setting {name}: {value} {wrong}")
        if not 0 < self.threshold < math.inf:
            raise InputError(f"odometry setting threshold: {self.threshold} is not above 0; the thesis has 0.0003")


THESIS = OdometrySettings()
PYSLAM_2024 = OdometrySettings(threshold=0.0004, rotate_first=True, shift_gate=1.5, scale_gate=0.015,
                               alignment="pose")
PRESETS = {"2021": THESIS, "2024": PYSLAM_2024}
