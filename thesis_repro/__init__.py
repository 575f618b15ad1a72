"""A reproduction of a thesis on keypoint masks from segmentation for monocular visual odometry.

The main names: Sequence, keypoint_mask, LabelMasks, Odometry, OdometrySettings, THESIS, run,
build_unet and InputError. Names are imported on first use, so TensorFlow is loaded only for
build_unet.
"""

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

from thesis_repro.errors import InputError, missing_package

__all__ = [
    "THESIS",
    "InputError",
    "LabelMasks",
    "MaskSettings",
    "Masks",
    "Matches",
    "Odometry",
    "OdometrySettings",
    "Result",
    "Sequence",
    "Step",
    "build_unet",
    "keypoint_mask",
    "run",
    "run_many",
]

if TYPE_CHECKING:
    __version__: str
    from thesis_repro.data.kitti import Sequence
    from thesis_repro.mask_files import LabelMasks
    from thesis_repro.masks import MaskSettings, keypoint_mask
    from thesis_repro.odometry import THESIS, Odometry, OdometrySettings, run, run_many
    from thesis_repro.odometry.runs import Masks, Result
    from thesis_repro.odometry.types import Matches, Step
    from thesis_repro.segmentation.unet import build_unet
else:
    _HOMES = {
        "Sequence": "data.kitti",
        "keypoint_mask": "masks",
        "LabelMasks": "mask_files",
        "MaskSettings": "masks",
        "Masks": "odometry.runs",
        "Result": "odometry.runs",
        "run": "odometry.runs",
        "run_many": "odometry.runs",
        "Matches": "odometry.types",
        "Step": "odometry.types",
        "Odometry": "odometry",
        "OdometrySettings": "odometry",
        "THESIS": "odometry",
        "build_unet": "segmentation.unet",
    }

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            return metadata.version("thesis-repro")
        if name not in _HOMES:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            home = import_module(f"{__name__}.{_HOMES[name]}")
        except ImportError as error:
            missing = missing_package(error)
            if missing is None:
                raise
            # not an ImportError, so that help() and hasattr() work without TensorFlow
            raise AttributeError(f"{name}: {missing}") from None
        return getattr(home, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
