"""Visual odometry with one camera, and keypoint masks from segmentation: a thesis, reproduced.

A few lines of use::

    import thesis_repro as tr

    sequence = tr.Sequence("world/kitti", 0)  # tr.Sequence.from_arrays: frames in memory
    runs = {
        "all": (tr.THESIS, None),
        "masks": (tr.THESIS, tr.LabelMasks("labels", sequence, 10)),
        "few": (tr.OdometrySettings(detector=tr.spread(200), estimator=tr.refined), None),
    }
    for name, result in tr.run_many(sequence, runs).items():  # tr.run: a single run
        print(name, tr.metrics.rmse(result.poses, sequence.poses), result)
        result.write_kitti(f"{name}.txt")

Detectors: spread, filled, filtered, orb; without one, Shi-Tomasi as in the thesis. Odometry takes
one frame at a time. keypoint_mask makes a mask from a label map. InputError says what to do.
Names are imported on first use, TensorFlow when build_unet is called. Recipes: docs/own-data.md.
"""

from importlib.metadata import version
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
        SequenceLike,
        Step,
        keypoint_mask,
        refined,
        run,
        run_many,
    )
    from thesis_repro.odometry import metrics
    from thesis_repro.odometry.keypoints import filled, filtered, orb, spread
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
    "SequenceLike",
    "Step",
    "build_unet",
    "filled",
    "filtered",
    "keypoint_mask",
    "metrics",
    "orb",
    "refined",
    "run",
    "run_many",
    "spread",
]


if not TYPE_CHECKING:  # a type checker sees the names above, and no others

    def __getattr__(name: str) -> Any:
        if name == "__version__":
            return version("thesis-repro")
        unknown = AttributeError(f"module {__name__!r} has no attribute {name!r}")
        if name.startswith("_"):
            raise unknown
        try:
            if name == "metrics":
                from thesis_repro.odometry import metrics

                return metrics
            from thesis_repro import _face
        except ImportError as error:
            missing = missing_package(error)
            if missing is None:
                raise
            # not an ImportError, so that help() and hasattr() work without OpenCV
            raise AttributeError(f"{name}: {missing}") from None
        if name not in __all__ and name not in _face.DETECTORS:
            raise unknown
        return (vars(_face) | _face.DETECTORS)[name]


def __dir__() -> list[str]:
    return sorted([*__all__, "__version__"])
