"""A reproduction of a thesis on keypoint masks from segmentation for monocular visual odometry.

The main names: Sequence, keypoint_mask, LabelMasks, Odometry, OdometrySettings, THESIS, run,
build_unet and InputError. Names are imported on first use, so TensorFlow is loaded only for
build_unet.
"""

from importlib import metadata
from typing import TYPE_CHECKING, Any

from thesis_repro.errors import InputError, missing_package

if TYPE_CHECKING:
    __version__: str
    from thesis_repro._face import (
        THESIS,
        LabelMasks,
        Masks,
        MaskSettings,
        Matches,
        Odometry,
        OdometrySettings,
        Result,
        Sequence,
        Step,
        filled,
        filtered,
        keypoint_mask,
        orb,
        refined,
        run,
        run_many,
        spread,
    )
    from thesis_repro.segmentation.unet import build_unet

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
    "filled",
    "filtered",
    "keypoint_mask",
    "orb",
    "refined",
    "run",
    "run_many",
    "spread",
]


if not TYPE_CHECKING:  # a type checker sees the names above, and no others

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            return metadata.version("thesis-repro")
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        try:
            if name == "build_unet":
                from thesis_repro.segmentation.unet import build_unet

                return build_unet
            from thesis_repro import _face
        except ImportError as error:
            missing = missing_package(error)
            if missing is None:
                raise
            # not an ImportError, so that help() and hasattr() work without TensorFlow
            raise AttributeError(f"{name}: {missing}") from None
        return getattr(_face, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__, "__version__"})
