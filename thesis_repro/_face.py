"""The names of the package but build_unet, which needs TensorFlow."""

from thesis_repro.data.kitti import Sequence
from thesis_repro.mask_files import LabelMasks
from thesis_repro.masks import MaskSettings, keypoint_mask
from thesis_repro.odometry import (
    THESIS,
    Masks,
    Matches,
    Odometry,
    OdometrySettings,
    Result,
    Step,
    run,
    run_many,
)
from thesis_repro.odometry.estimators import refined
from thesis_repro.odometry.keypoints import filled, filtered, orb, spread

__all__ = [
    "THESIS",
    "LabelMasks",
    "MaskSettings",
    "Masks",
    "Matches",
    "Odometry",
    "OdometrySettings",
    "Result",
    "Sequence",
    "Step",
    "filled",
    "filtered",
    "keypoint_mask",
    "orb",
    "refined",
    "run",
    "run_many",
    "spread",
]
