"""A reproduction of a thesis on keypoint masks from segmentation for monocular visual odometry.

The main names: Sequence, keypoint_mask, LabelMasks, Odometry, OdometrySettings, THESIS, run,
build_unet and InputError. Names are imported on first use, so TensorFlow is loaded only for
build_unet.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from thesis_repro.errors import InputError, missing_package

__all__ = [
    "THESIS",
    "InputError",
    "LabelMasks",
    "Odometry",
    "OdometrySettings",
    "Sequence",
    "build_unet",
    "keypoint_mask",
    "run",
]

if TYPE_CHECKING:
    from thesis_repro.data.kitti import Sequence
    from thesis_repro.mask_files import LabelMasks
    from thesis_repro.masks import keypoint_mask
    from thesis_repro.odometry import THESIS, Odometry, OdometrySettings, run
    from thesis_repro.segmentation.unet import build_unet
else:
    _HOMES = {
        "Sequence": "data.kitti",
        "keypoint_mask": "masks",
        "LabelMasks": "mask_files",
        "Odometry": "odometry",
        "OdometrySettings": "odometry",
        "THESIS": "odometry",
        "run": "odometry",
        "build_unet": "segmentation.unet",
    }

    def __getattr__(name: str) -> Any:
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            home = import_module(f"{__name__}.{_HOMES[name]}")
        except ImportError as error:
            raise missing_package(error) or error from None
        return getattr(home, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
