"""The public names of the package, but for `metrics`, which takes half a second to load."""

# ruff: noqa: F401  they are imported for others

from typing import Any

from thesis_repro.data.arrays import SequenceLike
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import missing_package
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
from thesis_repro.odometry.keypoints import DETECTORS


def build_unet(
    input_shape: tuple[int | None, int | None, int],
    n_classes: int,
    base_filters: int = 64,
    corrected_blocks: bool = False,
) -> Any:
    """Build the U-Net of appendix A.4; (320, 320, 1), 35 are those of the thesis.

    The arguments are explained in thesis_repro.segmentation.unet, which needs TensorFlow.
    """
    try:
        from thesis_repro.segmentation import unet
    except ImportError as error:
        raise missing_package(error) or error from None
    return unet.build_unet(input_shape, n_classes, base_filters, corrected_blocks)
