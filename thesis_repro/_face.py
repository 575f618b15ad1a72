"""The names of the package but build_unet, which needs TensorFlow."""

# ruff: noqa: F401  they are imported for others

from thesis_repro.data.kitti import Sequence
from thesis_repro.masks import MaskSettings, keypoint_mask
from thesis_repro.masks.folders import LabelMasks
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
