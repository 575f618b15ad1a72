"""Settings of the odometry: the thesis's and alternatives."""

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass, fields
from importlib import import_module
from typing import Any

import numpy as np

from thesis_repro.errors import InputError
from thesis_repro.odometry import estimators

CHOICES = {
    "detector": ("shi-tomasi", "orb"),
    "choice": ("strongest", "spread"),
    "mask_mode": ("detect", "filter"),
    "estimator": tuple(estimators.ESTIMATORS),
}
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
    "fill": (0, 1000),
    "min_distance": (0, 10_000),
    "redetect_below": (0, 2**31 - 1),
    "quality": (0, 1),
    "threshold": (1e-9, 1e9),
    "block_size": (1, 31),
    "window": (3, 101),
    "levels": (0, 10),
    "shuffle_seed": (0, 2**32 - 1),
    "scale_gate": (0, math.inf),
}


@dataclass(frozen=True)
class OdometrySettings:
    """Settings of the odometry. The defaults are the thesis's.

    detector: "shi-tomasi", or "orb" (detection only; points are still tracked).
    max_keypoints: largest number of keypoints, 0 for no limit. min_distance, quality, block_size
    (all Shi-Tomasi): least distance between keypoints, pixels; least strength of a keypoint,
    relative to the strongest one; side of the square over which gradients are summed, pixels.
    window, levels: side of the tracker's window, pixels, and the number of times it halves the
    frame.
    choice: the "strongest" max_keypoints, as in the thesis, or as many "spread" ones: the strongest
    that are as far apart as their number allows (keypoints.spread).
    fill: with a mask, number of keypoints in each of 16 x 5 fields of the frame that is filled up
    from outside the mask (keypoints.filled). 0: none, as in the thesis.
    mask_mode: "detect" gives the mask to the detector, which returns up to max_keypoints inside it;
    "filter" drops keypoints outside the mask.
    redetect_below: if fewer points than this were tracked into a frame, new keypoints replace all
    of them.
    threshold: largest distance of an inlier of the essential matrix, in normalised image
    coordinates.
    shuffle_seed: seed with which the matched points are shuffled before RANSAC; None: not shuffled.
    RANSAC's own seed is fixed.
    estimator: how the motion follows from the essential matrix, which allows four motions.
    "thesis": all points vote for one of the four, as in PySLAM. "inliers": only the inliers vote
    (audit rows 13, 29). "refined": the smaller of the two possible rotations is taken, and the
    motion is refitted by least squares to all points near it. If a car cannot make this motion
    within a frame, another one is searched for (refined.motion_prior).
    scale_gate: metres; a shorter step does not move the pose.
    """

    detector: str = "shi-tomasi"
    max_keypoints: int = 2000
    choice: str = "strongest"
    fill: int = 0
    min_distance: float = 3
    mask_mode: str = "detect"
    redetect_below: int = 2000
    quality: float = 0.01
    block_size: int = 5
    window: int = 21
    levels: int = 3
    threshold: float = 0.0003
    shuffle_seed: int | None = None
    estimator: str = "thesis"
    scale_gate: float = 0.1

    def of_detection(self) -> tuple:
        """Return the settings that decide which keypoints are found."""
        return tuple(value for name, value in vars(self).items() if name not in AFTER_DETECTION)

    def order(self, frame: int, matches: int) -> np.ndarray | slice:
        """Return the order in which RANSAC takes matches, (N,) indices; a slice: as they are."""
        if self.shuffle_seed is None:
            return slice(None)
        return np.random.default_rng((self.shuffle_seed, frame)).permutation(matches)

    def detect_function(self) -> Callable:
        """Return what finds keypoints: OpenCV's call, or `keypoints.detect` for other choices."""
        if self.choice == "spread" or self.fill:
            sharing = import_module("thesis_repro.odometry.sharing")
            return sharing.SharedCalls().detect  # computes the strength of corners once a frame
        if self.detector == "orb" or self.mask_mode == "filter":
            return import_module("thesis_repro.odometry.keypoints").detect
        return import_module("thesis_repro.odometry.odometry").detect

    def new_estimator(self, calls: Any) -> Any:
        """Return a new object of the estimator. calls: see odometry.Calls."""
        return estimators.new_estimator(self.estimator, calls)

    def __post_init__(self) -> None:
        for name, choices in CHOICES.items():
            value = getattr(self, name)
            if value not in choices:
                raise InputError(
                    f"odometry setting {name}: {value!r} is unknown; "
                    f"choose one of {', '.join(choices)}"
                )
        if self.choice == "spread" and not self.max_keypoints:
            raise InputError('odometry setting choice: "spread" needs max_keypoints of 1 or more')
        for field in fields(self):
            if field.name in LIMITS:
                _check_number(field.name, getattr(self, field.name), field.type)


def _check_number(name: str, value: Any, kind: Any) -> None:
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


THESIS = OdometrySettings()
