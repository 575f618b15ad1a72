"""Detectors beside the thesis's, for settings: OdometrySettings(detector=spread(200)).

A new one is a function or, with a number, a class here, and its name in DETECTORS.

A detector is a function of a frame (height, width), settings and a mask, (height, width) or None,
which allows keypoints where it is not 0. It returns (N, 2) float32 pixels, strongest first. Those
with a number are small objects, equal if their numbers are. They are quicker on a frame that nobody
can change (`corners.detect`). corners is imported where it is used, because it loads the compiler,
which most runs do without.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np

from thesis_repro.odometry.settings import THESIS, OdometrySettings, check_number


def orb(
    frame: np.ndarray, settings: OdometrySettings = THESIS, mask: np.ndarray | None = None
) -> np.ndarray:
    """ORB's keypoints, still tracked by Lucas-Kanade."""
    number = settings.max_keypoints or frame.size  # ORB takes 0 for none
    points = cv2.KeyPoint_convert(cv2.ORB_create(number).detect(frame, mask))
    return np.reshape(points, (-1, 2)).astype(np.float32, copy=False)


@dataclass(frozen=True)
class spread:  # it is called like a function
    """N of the strongest keypoints, as far apart as their number allows.

    The field calls it adaptive non-maximal suppression. The distance, whole pixels, is found by
    bisection in each frame: the largest one that leaves `number`.
    """

    number: int

    def __post_init__(self) -> None:
        check_number("number of keypoints", self.number, int)

    def __call__(
        self,
        frame: np.ndarray,
        settings: OdometrySettings = THESIS,
        mask: np.ndarray | None = None,
    ) -> np.ndarray:
        """Find the keypoints of a frame."""
        from thesis_repro.odometry import corners

        near, far = settings.min_distance, max(frame.shape)
        settings = replace(settings, max_keypoints=self.number)
        chosen = corners.detect(frame, settings, mask)
        while len(chosen) == self.number and far - near > 1:
            middle = int((near + far) / 2)
            points = corners.detect(frame, replace(settings, min_distance=middle), mask)
            if len(points) == self.number:
                near, chosen = middle, points
            else:
                far = middle
        return chosen


@dataclass(frozen=True)
class filled:
    """Keypoints inside the mask, and more where the mask leaves few.

    Of 16 x 5 fields of the frame (the field calls it bucketing), each with fewer than `number`
    keypoints gets its strongest ones that are min_distance away from them. detector: finds those
    inside the mask; None: the thesis's.
    """

    FIELDS: ClassVar = (5, 16)  # rows and columns into which a frame is divided

    number: int
    detector: Callable | None = None

    def __post_init__(self) -> None:
        check_number("number of keypoints", self.number, int)

    def __call__(
        self,
        frame: np.ndarray,
        settings: OdometrySettings = THESIS,
        mask: np.ndarray | None = None,
    ) -> np.ndarray:
        """Find the keypoints of a frame."""
        from thesis_repro.odometry import corners

        points = (self.detector or corners.detect)(frame, settings, mask)
        if mask is None:
            return points
        everywhere = corners.detect(frame, replace(settings, max_keypoints=0))
        chosen = list(points)
        fields_of_points = self._fields(points, frame.shape)
        fields_of_others = self._fields(everywhere, frame.shape)
        for field in range(self.FIELDS[0] * self.FIELDS[1]):
            taken = list(points[fields_of_points == field])
            for candidate in everywhere[fields_of_others == field]:
                if len(taken) >= self.number:
                    break
                distances = np.linalg.norm(np.reshape(taken, (-1, 2)) - candidate, axis=1)
                if (distances >= settings.min_distance).all():
                    taken.append(candidate)
                    chosen.append(candidate)
        return np.reshape(chosen, (-1, 2)).astype(np.float32)

    def _fields(self, points: np.ndarray, size: tuple[int, ...]) -> np.ndarray:
        """Number of the field in which each of N points (N, 2) lies, (N,)."""
        down, across = self.FIELDS
        columns, rows = (points // (size[1] / across, size[0] / down)).astype(int).T
        return rows * across + columns


def filtered(
    frame: np.ndarray, settings: OdometrySettings = THESIS, mask: np.ndarray | None = None
) -> np.ndarray:
    """The thesis's keypoints of the whole frame, without those outside the mask."""
    from thesis_repro.odometry import corners

    points = corners.detect(frame, settings)
    if mask is None:
        return points
    columns, rows = np.rint(points).astype(int).T
    return points[mask[rows, columns] > 0]


# {name: detector}. Each is thesis_repro.NAME and --detector NAME, or NAME=N if it needs a number.
# The first line of its docstring explains it.
DETECTORS: dict[str, Callable] = {
    detector.__name__: detector for detector in (orb, filtered, spread, filled)
}
