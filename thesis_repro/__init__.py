"""A reproduction of a thesis on keypoint masks from semantic segmentation for monocular visual
odometry.

The main names: Sequence, keypoint_mask, LabelMasks, Odometry, OdometrySettings, THESIS, run,
build_unet and InputError. Names are imported on first use, so TensorFlow is loaded only for
build_unet.
"""

from importlib import import_module
from typing import Any

from thesis_repro.errors import InputError

_HOMES = {
    "Sequence": "data.kitti",
    "keypoint_mask": "masks",
    "LabelMasks": "masks",
    "Odometry": "odometry",
    "OdometrySettings": "odometry",
    "THESIS": "odometry",
    "run": "odometry",
    "build_unet": "segmentation.unet",
}

__all__ = ["InputError", *_HOMES]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_HOMES]
