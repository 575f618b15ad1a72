"""The four calls of the odometry for many runs over the same frames: what several ask for, once.

The results equal those of separate runs with OpenCV's calls, to the bit.
"""

from collections.abc import Iterable
from typing import Any, NamedTuple

import cv2
import numpy as np

import opencv_exact
from thesis_repro.odometry import corners
from thesis_repro.odometry.loop import PROBABILITY, TERMINATION, Calls
from thesis_repro.odometry.settings import THESIS, OdometrySettings


class _Tracks(NamedTuple):
    """Points of many runs, tracked together from one frame into the next."""

    previous: np.ndarray
    keys: np.ndarray  # sorted, see `_keys`
    tracked: np.ndarray  # (N, 2), in the order of the keys
    success: np.ndarray  # (N,) booleans


class SharedCalls:
    """The four calls, which remember what one run has asked for until the next frame.

    The corner strength is computed once a frame (`corners`). Lucas-Kanade tracks each point
    independently, so all points of all runs are tracked in one call. The search for the essential
    matrix and the vote are those of opencv_exact.
    """

    def __init__(self) -> None:
        self.calls = Calls(self.detect, self.track, self.find_essential_matrix, recover_pose)
        self._start(None)

    def _start(self, frame: np.ndarray | None) -> None:
        self._frame = frame
        self._tracks: _Tracks | None = None
        self._detected: dict[tuple, tuple] = {}
        self._tracked: dict[bytes, tuple[np.ndarray, np.ndarray]] = {}
        self._matrices: dict[tuple, tuple] = {}

    def expect(self, frame: np.ndarray, runs: Iterable[Any]) -> None:
        """Forget the frame before, and track the points of all runs into this one.

        runs: `Odometry`, or what has `points` in the frame before, `previous`.
        """
        self._turn_to(frame)
        followed = {run.points.tobytes(): run for run in runs if len(run.points)}
        if not followed:
            return
        previous: Any = next(iter(followed.values())).previous  # the same for all runs
        keys = np.unique(np.concatenate([_keys(run.points) for run in followed.values()]))
        points = keys.view(np.float32).reshape(-1, 2)
        self._tracks = _Tracks(previous, keys, *track(previous, frame, points))

    def track(
        self,
        previous: np.ndarray,
        current: np.ndarray,
        points: np.ndarray,
        settings: OdometrySettings = THESIS,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Like `loop.track`. Points that `expect` has tracked are looked up."""
        tracks = self._tracks
        is_usual = (settings.window, settings.levels) == (THESIS.window, THESIS.levels)
        if tracks is None or tracks.previous is not previous or not is_usual:
            return track(previous, current, points, settings)
        key = points.tobytes()
        if key not in self._tracked:
            indices = np.searchsorted(tracks.keys, _keys(points))
            self._tracked[key] = tracks.tracked[indices], tracks.success[indices]
        return self._tracked[key]

    def detect(
        self,
        frame: np.ndarray,
        settings: OdometrySettings = THESIS,
        mask: np.ndarray | None = None,
    ) -> np.ndarray:
        """Find the keypoints of the settings."""
        self._turn_to(frame)
        # the mask is remembered, too, so that no other array gets its identity
        key = (id(mask), *settings.detection_values())
        if key not in self._detected:
            find = settings.detector or corners.detect
            self._detected[key] = mask, find(frame, settings, mask)
        return self._detected[key][1]

    def find_essential_matrix(
        self, current: np.ndarray, previous: np.ndarray, threshold: float
    ) -> tuple[np.ndarray | None, np.ndarray | None]:
        """Like `loop.find_essential_matrix`."""
        key = (current.tobytes(), previous.tobytes(), threshold)
        if key not in self._matrices:
            self._matrices[key] = find_essential_matrix(current, previous, threshold)
        return self._matrices[key]

    def _turn_to(self, frame: np.ndarray) -> None:
        if frame is not self._frame:
            self._start(frame)


def _keys(points: np.ndarray) -> np.ndarray:
    """The bits of each of N points (N, 2) float32 as one integer, (N,)."""
    return np.ascontiguousarray(points).view(np.int64).ravel()


def track(
    previous: np.ndarray,
    current: np.ndarray,
    points: np.ndarray,
    settings: OdometrySettings = THESIS,
) -> tuple[np.ndarray, np.ndarray]:
    """Track points (N, 2) as `loop.track` does, in less time.

    The matching error is not computed, because nothing uses it. Computing it, OpenCV also rejects
    points whose window leaves the frame; this function does that itself.
    """
    window = settings.window
    tracked, status, _ = opencv_exact.track(
        previous,
        current,
        points,
        winSize=(window, window),
        maxLevel=settings.levels,
        criteria=TERMINATION,
        flags=cv2.OPTFLOW_LK_GET_MIN_EIGENVALS,
    )
    window_corner = tracked - (window - 1) / 2  # upper left
    touches_frame = (window_corner >= -window) & (window_corner < current.shape[::-1])
    return tracked, (status.ravel() == 1) & touches_frame.all(axis=1)


def find_essential_matrix(
    current: np.ndarray, previous: np.ndarray, threshold: float
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Like `loop.find_essential_matrix`, in less time."""
    return opencv_exact.find_essential_matrix(
        current, previous, prob=PROBABILITY, threshold=threshold
    )


def recover_pose(
    matrix: np.ndarray, current: np.ndarray, previous: np.ndarray
) -> tuple[int, np.ndarray, np.ndarray]:
    """Like `loop.recover_pose`, in less time."""
    votes, rotation, translation, _ = opencv_exact.recover_pose(matrix, current, previous)
    return votes, rotation, translation.ravel()
