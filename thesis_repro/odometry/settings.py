"""Settings of the odometry: the thesis's and alternatives."""

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import numpy as np

from thesis_repro.errors import InputError

# Settings that do not change which keypoints are found in a frame. Runs that differ in nothing else
# share keypoints, so a new setting belongs here only if it acts later.
AFTER_DETECTION = {
    "redetect_below",
    "window",
    "levels",
    "threshold",
    "shuffle_seed",
    "estimator",
    "scale_gate",
}
# {name: (least, most)}
LIMITS = {
    "max_keypoints": (0, 2**31 - 1),
    "min_distance": (0, 10_000),
    "redetect_below": (0, 2**31 - 1),
    "quality": (1e-9, 1),
    "threshold": (1e-9, 1e9),
    "block_size": (1, 31),
    "window": (3, 101),
    "levels": (0, 10),
    "shuffle_seed": (0, 2**32 - 1),
    "scale_gate": (0, math.inf),
    "number of keypoints": (1, 2**31 - 1),  # of spread and filled
}


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of the odometry. The defaults are the thesis's.

    detector: finds the keypoints of a frame. None: the strongest Shi-Tomasi corners, as in the
    thesis. Others are in `keypoints.DETECTORS`: spread(200), filled(5), filtered, orb.
    estimator: how the motion follows from the essential matrix, which allows four motions. None:
    all points vote for one of the four, as in PySLAM. Others are in `estimators`. With
    VoteOfInliers only the inliers vote (audit rows 13, 29). With `refined` the smaller of the two
    possible rotations is taken, and the motion is refitted by least squares to all points near it.
    If a car cannot make this motion within a frame, another one is searched for
    (refined.motion_prior).
    max_keypoints: largest number of keypoints, 0 for no limit. min_distance, quality, block_size
    (all Shi-Tomasi): least distance between keypoints, pixels; least strength of a keypoint,
    relative to the strongest one; side of the square over which gradients are summed, pixels.
    window, levels: side of the tracker's window, pixels, and the number of times it halves the
    frame.
    redetect_below: if fewer points than this were tracked into a frame, new keypoints replace all
    of them.
    threshold: largest distance of an inlier of the essential matrix, in normalised image
    coordinates.
    shuffle_seed: seed with which the matched points are shuffled before RANSAC; None: not shuffled.
    RANSAC's own seed is fixed.
    scale_gate: metres; a shorter step does not move the pose.
    """

    detector: Callable | None = None
    estimator: Callable | None = None
    max_keypoints: int = 2000
    min_distance: float = 3
    redetect_below: int = 2000
    quality: float = 0.01
    block_size: int = 5
    window: int = 21
    levels: int = 3
    threshold: float = 0.0003
    shuffle_seed: int | None = None
    scale_gate: float = 0.1

    def detection_values(self) -> tuple:
        """Return the settings that decide which keypoints are found."""
        return tuple(value for name, value in vars(self).items() if name not in AFTER_DETECTION)

    def order(self, frame: int, matches: int) -> np.ndarray | slice:
        """Return the order in which RANSAC takes matches, (N,) indices; a slice: as they are."""
        if self.shuffle_seed is None:
            return slice(None)
        return np.random.default_rng((self.shuffle_seed, frame)).permutation(matches)

    def record(self) -> dict[str, Any]:
        """Return the settings as a record of results has them, equal in every process."""
        return {
            name: _text(value) if callable(value) else value for name, value in vars(self).items()
        }

    def __post_init__(self) -> None:
        for name, example in {"detector": "spread(200)", "estimator": "refined"}.items():
            value = getattr(self, name)
            if value is not None and not callable(value):
                raise InputError(
                    f"odometry setting {name}: {value!r} is not a function or object, such as "
                    f"thesis_repro.{example}"
                )
        if isinstance(self.detector, type):
            raise InputError(
                f"odometry setting detector: {self.detector.__name__} needs its number, as in "
                f"thesis_repro.{self.detector.__name__}(200)"
            )
        for field in fields(self):
            if field.name in LIMITS:
                check_number(field.name, getattr(self, field.name), field.type)


def check_number(name: str, value: Any, kind: Any) -> None:
    """Raise InputError unless a setting is a number of its kind, a type, and within its LIMITS."""
    if value is None and kind == int | None:
        return
    least, most = LIMITS[name]
    # numbers of numpy are of these abstract kinds, too
    number: Any = numbers.Real if kind is float else numbers.Integral
    words = "number" if kind is float else "whole number"
    if not isinstance(value, number) or not least <= value <= most:
        raise InputError(
            f"odometry setting {name}: {value!r} is not a {words} from {least} to {most}"
        )


def _text(value: Any) -> str:
    """The name of a function, and of an object that is called like one with what it holds."""
    if is_dataclass(value) and not isinstance(value, type):
        parts = ", ".join(_text(part) for part in vars(value).values())
        return f"{type(value).__qualname__}({parts})"
    if hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    return repr(value)


THESIS = OdometrySettings()
