"""The drives of the embedded world: eleven sequences, their roads, cameras and motions.

A place on a street is (s, d): metres along the middle line of the road, and metres to the right of
that line.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from thesis_repro.data import geometry

STEP = 0.25  # metres between the stored points of a track
# metres over which the curvature changes, because a driver turns the wheel gradually
SMOOTHING = 3.0
BEHIND, AHEAD = 30.0, 170.0  # metres of street behind the first and ahead of the last camera
CAMERA_HEIGHT = 1.65
TURN_RATE = np.radians(4.4)  # most radians a frame; the driver slows down in sharper bends
ACCELERATION = 0.03  # metres a frame, a frame: 3 m/s^2
# frames: the parts of a stop, and from one stop to the next
BRAKING, WAITING, STARTING, ROUND = 16, 12, 18, 150
ZONES = ("row", "gardens", "park", "wall")  # what lies beside a road; row: houses side by side


@dataclass(frozen=True)
class Style:
    """The look of a street; widths in metres."""

    half: float = 5.5  # half of the road's width
    road: str = "road"  # its texture
    sidewalk: float = 2.6  # 0: a highway, with low walls
    parked: tuple = (0.0, 0.0)  # share of the parking places that are taken, left and right
    zones: tuple = (0.55, 0.2, 0.15, 0.1)  # shares of ZONES
    trees: float = 0.5  # density of street trees
    persons: float = 0.05  # for each metre of sidewalk
    traffic: float = 0.01  # oncoming cars for each metre
    sunny: bool = True
    sun: tuple = (0.5, 0.8)  # azimuth and elevation of the sun (radians)
    # gray of the sky between the clouds, and of the haze at the horizon
    sky: tuple = (150.0, 205.0)
    haze: float = 0.003  # extinction, 1/m
    leaders: tuple = ()  # distances of cars that drive ahead at the camera's pace
    crossing: float | None = None  # s of a crossing with cars that pass ahead of a waiting camera


class Track:
    """The middle line of a road, with points stored every STEP metres.

    s, x, z, heading, curvature: (n,), metres, radians to the right of z, and 1/m, positive to the
    right.
    closed: whether the road ends at its start, so that larger s begin another round.
    """

    def __init__(
        self,
        pieces: tuple[tuple[float, float], ...],
        start: float,
        stop: float,
        origin: tuple[float, float] = (0.0, 0.0),
        heading: float = 0.0,
        closed: bool = False,
    ) -> None:
        """pieces: (metres, degrees to the right) of each piece from s = 0, repeated up to `stop`.

        start, stop: s of both ends, start <= 0; before s = 0 the road is straight. origin, heading:
        at s = 0.
        """
        self.s = start + STEP * np.arange(int(np.ceil((stop - start) / STEP)) + 1)
        self.closed = closed
        curvature = np.zeros(len(self.s))
        begin = 0.0
        while pieces and begin < stop:
            for length, degrees in pieces:
                piece = (self.s >= begin) & (self.s < begin + length)
                curvature[piece] = np.radians(degrees) / length
                begin += length
        window = int(SMOOTHING / STEP)
        padded = np.pad(curvature, (window // 2, window - 1 - window // 2), mode="edge")
        total = np.concatenate([[0.0], np.cumsum(padded)])
        self.curvature = (total[window:] - total[:-window]) / window
        # The trapezoidal rule integrates the curvature to the heading, and its direction to the
        # position.
        first = int(round(-start / STEP))
        mean_curvature = 0.5 * (self.curvature[1:] + self.curvature[:-1])
        turn = np.concatenate([[0.0], np.cumsum(mean_curvature) * STEP])
        self.heading = heading + turn - turn[first]
        middle = 0.5 * (self.heading[1:] + self.heading[:-1])
        x = np.concatenate([[0.0], np.cumsum(np.sin(middle)) * STEP])
        z = np.concatenate([[0.0], np.cumsum(np.cos(middle)) * STEP])
        self.x, self.z = origin[0] + x - x[first], origin[1] + z - z[first]

    def along(self, s: float | np.ndarray) -> float | np.ndarray:
        """Return s, on a closed track reduced to its first round."""
        return s % self.s[-1] if self.closed else s

    def at(self, s: float | np.ndarray, d: float | np.ndarray = 0.0) -> tuple[Any, Any, Any]:
        """Return (x, z, heading) of places (s, d), numbers or arrays of one shape."""
        s = self.along(s)
        heading = np.interp(s, self.s, self.heading)
        x = np.interp(s, self.s, self.x) + d * np.cos(heading)
        z = np.interp(s, self.s, self.z) - d * np.sin(heading)
        return x, z, heading


@dataclass(frozen=True)
class Drive:
    """One sequence: the course of its road, the way it is driven and its look."""

    pieces: tuple  # (metres, degrees to the right) of the road's pieces, repeated
    pace: float  # metres a frame
    frames: int  # length of the whole drive
    style: Style
    lane: float = 1.7  # metres right of the road's middle
    closed: bool = False  # the pieces lead back to the start, on the same road
    stop: int | None = None  # frame at which the car has stopped; it stops again every ROUND frames
    noise: float = 2.0  # standard deviation of the sensor's noise, gray values
    level: float = 104.0  # mean gray that the exposure aims at


# Shares of ZONES.
_CITY, _SUBURB, _GREEN = (0.55, 0.2, 0.15, 0.1), (0.2, 0.55, 0.15, 0.1), (0.0, 0.3, 0.65, 0.05)

DRIVES = {
    # City with right-angled turns both ways.
    "00": Drive(
        ((14, 0), (16, 90), (13, 0), (16, -90), (40, 0)),
        1.32,
        71,
        Style(parked=(0, 0.6), sun=(0.7, 0.75), sky=(140, 190)),
    ),
    # Highway: fast, wide, little texture, cars that overtake.
    "01": Drive(
        ((120, 0), (90, 14), (60, 0), (80, -18)),
        2.24,
        41,
        Style(
            half=7.5,
            road="highway",
            sidewalk=0.0,
            zones=_GREEN,
            sun=(-1.0, 0.9),
            sky=(170, 225),
            haze=0.004,
        ),
        lane=0.0,
        noise=1.6,
        level=122,
    ),
    # Suburb: an S.
    "02": Drive(
        ((8, 0), (28, 65), (6, 0), (34, -85), (15, 0), (26, 45)),
        1.32,
        54,
        Style(half=3.6, zones=_SUBURB, trees=0.7, sun=(2.4, 0.7), sky=(150, 200)),
        noise=2.2,
    ),
    # Lane between fields and gardens in long bends.
    "03": Drive(
        ((8, 0), (40, -38), (30, 22), (45, 40), (30, -28)),
        1.38,
        48,
        Style(
            half=3.3,
            sidewalk=1.6,
            zones=_GREEN,
            trees=0.3,
            sunny=False,
            sky=(185, 228),
            haze=0.006,
            persons=0.02,
        ),
        lane=1.6,
        noise=2.6,
    ),
    # Straight on in much traffic: two cars ahead, many that come towards it.
    "04": Drive(
        ((200, 0),),
        1.49,
        44,
        Style(
            parked=(0.6, 0),
            zones=(0.4, 0.2, 0.3, 0.1),
            leaders=(12.0, 26.0),
            traffic=0.08,
            sun=(-0.6, 0.6),
            sky=(135, 180),
        ),
        noise=1.8,
    ),
    # Old town with one turn to the left and one to the right.
    "05": Drive(
        ((12, 0), (16, -90), (34, 0), (15, 90), (25, 0), (24, 50)),
        1.21,
        61,
        Style(
            half=5.0,
            sidewalk=2.2,
            parked=(0.6, 0),
            zones=(0.75, 0.1, 0.1, 0.05),
            trees=0.2,
            persons=0.1,
            sunny=False,
            sky=(175, 222),
        ),
        noise=2.4,
    ),
    # Up a street, round its end and back beside it.
    "06": Drive(
        ((20, 0), (12, -90), (5, 0), (12, -90), (60, 0), (12, -90), (5, 0), (12, -90), (40, 0)),
        1.38,
        78,
        Style(half=4.0, zones=(0.1, 0.25, 0.6, 0.05), trees=0.8, sun=(0.2, 0.55), sky=(120, 165)),
        noise=1.6,
    ),
    # Waits at a light while others cross.
    "07": Drive(
        ((75, 0), (15, 90), (40, 0), (15, 90)),
        1.44,
        76,
        Style(parked=(0.45, 0.45), sun=(1.9, 0.8), sky=(150, 205), crossing=38.0, traffic=0.004),
        stop=26,
    ),
    # Residential streets: a gentle bend, then a sharp one.
    "08": Drive(
        ((10, 0), (20, 30), (10, 0), (15, -90), (20, 0), (22, -35), (25, 0)),
        1.21,
        62,
        Style(zones=_SUBURB, parked=(0.7, 0.7), sun=(-2.2, 0.85), sky=(155, 210)),
        noise=2.2,
    ),
    # Round a block, back to the start.
    "09": Drive(
        ((8, 0), (15, -90), (8, 0), (15, -90), (14, 0), (15, -90), (8, 0), (15, -90), (6, 0)),
        1.15,
        132,
        Style(half=3.4, zones=(0.5, 0.4, 0.1, 0.0), sunny=False, sky=(165, 215), haze=0.004),
        closed=True,
        noise=2.4,
    ),
    # A long tightening bend through a narrow street.
    "10": Drive(
        ((10, 0), (30, 35), (24, 50), (10, 0), (40, -60)),
        1.38,
        47,
        Style(
            half=4.4, sidewalk=1.8, parked=(0, 0.5), zones=_CITY, sun=(1.2, 0.65), sky=(130, 175)
        ),
        lane=1.3,
        noise=2.8,
        level=96,
    ),
}


# Purposes of random numbers. A generator's seed is (seed of the world, purpose, further whole
# numbers).
SWAY, SENSOR, IMAGE, STREET, TEXTURES = 1, 2, 3, 4, 7001


def scaled_camera(name: str, scale: float) -> tuple[tuple[int, int], np.ndarray]:
    """Return size (height, width) and intrinsics (3x3, pixels) of a sequence's camera at a scale.

    Whole coordinates are pixel centres, so half a pixel is added before and subtracted after
    scaling.
    """
    camera = geometry.CAMERAS[name]
    width, height = round(camera.width * scale), round(camera.height * scale)
    x, y = width / camera.width, height / camera.height
    centre_x = (camera.cx + 0.5) * x - 0.5
    centre_y = (camera.cy + 0.5) * y - 0.5
    intrinsics = [[camera.fx * x, 0, centre_x], [0, camera.fy * y, centre_y], [0, 0, 1.0]]
    return (height, width), np.array(intrinsics)


def _driven(drive: Drive, track: Track, frames: int, phase: float) -> np.ndarray:
    """Return the metres driven until each frame, (frames,).

    The car slows down for bends and stops. With acceleration a, the squared pace changes by at most
    2 a ds over a distance ds, forwards and backwards.
    """
    limit = drive.pace * (1 + 0.12 * np.sin(track.s / 11 + phase))
    limit = np.minimum(limit, TURN_RATE / np.maximum(np.abs(track.curvature), 1e-9))
    gain = 2 * ACCELERATION * STEP
    for k in range(len(limit) - 2, -1, -1):
        limit[k] = min(limit[k], np.sqrt(limit[k + 1] ** 2 + gain))
    for k in range(1, len(limit)):
        limit[k] = min(limit[k], np.sqrt(limit[k - 1] ** 2 + gain))
    share = np.ones(frames)
    if drive.stop is not None:
        stop = max(4, min(drive.stop, frames // 3))
        parts = [max(stop - BRAKING, 0), min(stop, BRAKING), WAITING, STARTING]
        share = np.interp(np.arange(frames) % ROUND, np.cumsum(parts), [1, 0, 0, 1])
    driven = np.zeros(frames)
    for k in range(1, frames):
        pace = np.interp(track.along(driven[k - 1]), track.s, limit)
        driven[k] = driven[k - 1] + share[k] * pace
    return driven


def poses_of(places: np.ndarray | list, angles: np.ndarray | list) -> np.ndarray:
    """Return camera-to-world poses (n, 4, 4).

    places: (n, 3) metres; angles: (n, 3) radians right, up, clockwise.
    """
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("YXZ", angles).as_matrix()
    poses[:, :3, 3] = places
    return poses


def way(name: str, frames: int, seed: int) -> tuple[Track, np.ndarray, np.ndarray]:
    """Return a sequence's `Track`, its camera-to-world poses in the street and the metres driven.

    Poses are (frames, 4, 4), metres driven (frames,).
    """
    drive = DRIVES[name]
    if drive.closed:
        track = Track(drive.pieces, 0.0, sum(length for length, _ in drive.pieces), closed=True)
    else:
        track = Track(drive.pieces, -BEHIND, frames * drive.pace * 1.15 + AHEAD)
    phase = np.random.default_rng((seed, SWAY, int(name))).uniform(0, 2 * np.pi, 6)
    driven = _driven(drive, track, frames, phase[0])
    # The sway depends on the metres driven, so the camera does not move while the car waits.
    x, z, heading = track.at(driven, drive.lane + 0.06 * np.sin(driven / 6 + phase[1]))
    pitch = np.radians(0.12) * np.sin(driven / 1.9 + phase[2])
    pitch += np.radians(0.08) * np.sin(driven / 0.83 + phase[3])
    roll = np.radians(0.12) * np.sin(driven / 2.7 + phase[4])
    y = -CAMERA_HEIGHT + 0.008 * np.sin(driven / 1.3 + phase[5])
    places = np.stack([x, y, z], axis=1)
    angles = np.stack([heading, pitch, roll], axis=1)
    return track, poses_of(places, angles), driven


def relative_to_first(poses: np.ndarray) -> np.ndarray:
    """Return poses (n, 4, 4) relative to the first one, which becomes exactly the identity."""
    result = poses.copy()
    result[:, :3, 3] -= poses[0, :3, 3]
    result[:, :3] = np.einsum("ji,njk->nik", poses[0, :3, :3], result[:, :3])
    result[0] = np.eye(4)
    return result
