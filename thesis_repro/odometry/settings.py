"""Settings of the odometry: the thesis's, those of a later PySLAM, and the alternatives."""

import math
from dataclasses import dataclass

from thesis_repro import InputError
from thesis_repro.odometry import pose

CHOICES = {"detector": ("shi-tomasi", "orb"), "mask_mode": ("detect", "filter"),
           "essential_method": tuple(pose.ESSENTIAL_METHODS), "estimator": ("thesis", "inliers", "refined"),
           "alignment": ("position", "pose")}


@dataclass(frozen=True)
class OdometrySettings:
    """The settings of the odometry; the defaults are the thesis's.

    detector: "shi-tomasi", or "orb" (detection only; points are still tracked).
    max_keypoints: largest number of keypoints, 0 for no limit. min_distance: between keypoints, pixels (Shi-Tomasi).
    quality: least strength of a keypoint, relative to the strongest one (Shi-Tomasi). block_size: side, in pixels, of
    the square over which gradients are summed (Shi-Tomasi). window, levels: of the tracker; side of its window in
    pixels, and number of times the frame is halved.
    mask_mode: "detect" gives the mask to the detector, which returns up to max_keypoints inside it; "filter" drops
    keypoints outside the mask.
    redetect_below: if fewer points than this were tracked into a frame, new keypoints replace all of them.
    essential_method: search for the essential matrix: "ransac", or OpenCV's "usac" or "usac-magsac".
    threshold: of that search, in normalised image coordinates.
    shuffle_seed: seed with which the matched points are shuffled before RANSAC; None: not shuffled. RANSAC's own seed
    is fixed.
    estimator: how the motion follows from the essential matrix. "thesis": all points vote on which of its four motions
    is the right one, as in PySLAM. "inliers": only the inliers vote (audit rows 13, 29). "refined": RANSAC's motion is
    refitted by least squares to all points near it, the rotation is the smaller of the two possible ones, and a motion
    that a car cannot make from one frame to the next is searched for again (refined.motion_prior).
    fallback: a step is estimated from all keypoints if the masked ones do not determine its motion, or if the motion
    differs too much from the previous step's (refined.motion_prior). Without masks it does nothing.
    scale_gate: metres; a shorter step does not move the pose. shift_gate: pixels; the same for the points' mean shift.
    rotate_first: rotate the pose before moving it.
    alignment: of both paths, for RMSE and MAE, see metrics.rmse.
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
