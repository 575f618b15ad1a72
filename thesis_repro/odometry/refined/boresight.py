"""The constant rotation between the odometry's camera and the frame of the true poses, and paths freed of it.

Directions are those of KITTI's camera: x right, y down, z forward. A rotation B takes a direction as the camera sees it
to the same direction in the frame of the true poses, d_true = B d_camera, and is written as three angles in degrees,
each turning by the right-hand rule: B = R_y(yaw) R_x(pitch) R_z(roll). So a positive yaw moves what is ahead to the
right, a positive pitch moves it up, a positive roll moves what is right down.

Every relative motion M of the camera is B M B^T in the frame of the true poses. With lengths taken from the truth, as
here, turning all motions by B gives P0 B P0^-1 P B^T for each pose P of a path that starts at P0: `turned` applies that
to a finished run, and needs no other one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pandas as pd

from thesis_repro import InputError
from thesis_repro.odometry import metrics
from thesis_repro.odometry.odometry import ROTATION
from thesis_repro.odometry.passes import Result

ANGLES = ("pitch", "yaw", "roll")
SHORTEST = 0.3  # metres: in a shorter step the direction of motion is lost in noise
WRONG = 20.0  # degrees between both directions of a step: it has failed, and says nothing about a constant angle
HUBER = 1.345  # standard deviations beyond which a residual counts linearly
ROUNDS = 10
NEIGHBOURS = 9  # steps: long enough to average noise out, shorter than a turn
BLOCK = 20  # steps at the least that are drawn together: neighbouring errors hang together
BLOCKS = 8  # of a sequence at the most
DRAWS = 200
# 95 %: Student's t of 1, 2, ... degrees of freedom, and of more
STUDENT = (12.71, 4.30, 3.18, 2.78, 2.57, 2.45, 2.36, 2.31, 2.26, 2.23, 2.1)
VAGUE = 1.0  # degrees: an angle whose interval reaches farther to either side is not determined
Paths = tuple[np.ndarray, np.ndarray]  # estimated and true poses of one sequence, (n, 4, 4) each


@dataclass(frozen=True)
class Boresight:
    """Angles and their intervals, degrees: pitch, yaw, roll, (3,); low and high, (3,). steps: that they come from.

    NaN where an angle is not determined: roll where the car neither turns nor changes its direction, all of them where
    there are too few steps.
    """

    angles: np.ndarray
    low: np.ndarray
    high: np.ndarray
    steps: int

    @property
    def usable(self) -> np.ndarray:
        """The angles to be applied, (3,): 0 in place of what is not determined."""
        return np.nan_to_num(self.angles)


def rotation(angles: Iterable[float]) -> np.ndarray:
    """B, 3x3, of pitch, yaw and roll in degrees."""
    pitch, yaw, roll = np.radians(list(angles))
    about_x, about_y, about_z = (cv2.Rodrigues(np.eye(3)[axis] * angle)[0]
                                 for axis, angle in enumerate((pitch, yaw, roll)))
    return about_y @ about_x @ about_z


def angles_of(b: np.ndarray) -> np.ndarray:
    """Pitch, yaw and roll in degrees of a rotation 3x3: what `rotation` is the inverse of."""
    return np.degrees([np.arcsin(-b[1, 2]), np.arctan2(b[0, 2], b[2, 2]), np.arctan2(b[1, 0], b[1, 1])])


def turned(poses: np.ndarray, angles: Iterable[float]) -> np.ndarray:
    """The path (n, 4, 4) with every relative motion turned by B; its first pose stays."""
    b = np.eye(4)
    b[:3, :3] = rotation(angles)
    return poses[0] @ b @ np.linalg.inv(poses[0]) @ poses @ b.T


def apply(result: Result, angles: Iterable[float]) -> Result:
    """A finished run with its path `turned`, in the poses and in the table of frames."""
    angles = list(angles)
    if not np.isfinite(angles).all():
        raise InputError(f"boresight {angles}: pitch, yaw and roll must be numbers of degrees; 0 for one that is open")
    poses = turned(result.poses, angles)
    columns = np.concatenate([poses[:, :3, 3], poses[:, :3, :3].reshape(-1, 9)], axis=1)
    return replace(result, poses=poses, frames=result.frames.assign(**dict(zip([*"xyz", *ROTATION], columns.T,
                                                                               strict=True))))


def estimate(paths: Sequence[Paths]) -> Boresight:
    """The rotation between both frames from one or more sequences: (estimated, true) poses, (n, 4, 4) each.

    Two kinds of vectors of a step must agree up to B: its direction of motion, and its rotation vector, whose axis
    shows in turns. For vectors s and B s exactly, B s - s = c x (B s + s) / 2 with the Gibbs vector c = 2 tan(angle/2)
    axis of B: linear in c, and solved with Huber's weights, each kind measured by its own robust standard deviation.
    The vectors' means over neighbouring steps serve as instruments: least squares would take each step's own noise,
    which is at right angles to c x noise, for a proof that the angles are zero.

    Intervals, 95 %: bootstrap over blocks of neighbouring steps, widened by Student's t where blocks are few. They hold
    what varies within the sequences, not what is common to all of a drive. The vaguest angle is left out, one at a
    time, until the others are determined.
    """
    vectors = [_vectors(*some) for some in paths]
    blocks = [block for some in vectors for block in _blocks(*some)]
    steps = sum(len(seen) for seen, _ in vectors)
    nothing = np.full(3, np.nan)
    if len(blocks) < 2:
        return Boresight(nothing, nothing, nothing, steps)
    known = np.ones(3, bool)
    best, reach = _with_reach(blocks, known)
    while reach.max() > VAGUE:  # an angle that may be anything must not drag the others along
        known[reach.argmax()] = False
        best, reach = _with_reach(blocks, known)
    angles, low, high = (np.where(known, some, np.nan) for some in (best, best - reach, best + reach))
    return Boresight(angles, low, high, steps)


def _with_reach(blocks, free):
    """The best angles, those that are not free being 0, and how far their intervals reach to either side."""
    random, count = np.random.default_rng(0), len(blocks)
    drawn = np.array([_fit([blocks[index] for index in random.integers(0, count, count)], free)
                      for _ in range(DRAWS)])
    return _fit(blocks, free), (drawn.std(axis=0) * np.sqrt(count / (count - 1))
                                * STUDENT[min(count - 1, len(STUDENT)) - 1])


def _vectors(estimated, true):
    """Directions and rotation vectors of the usable steps, (n, 2, 3) each: as the camera sees them, and in truth."""
    estimated, true = metrics.checked(estimated, true)
    motions = _motions(estimated), _motions(true)
    lengths = [np.linalg.norm(some[:, :3, 3], axis=1) for some in motions]
    seen, given = (np.stack([some[:, :3, 3] / np.maximum(length, 1e-9)[:, None],
                             [metrics.rotation_vector(one) for one in some]], axis=1)
                   for some, length in zip(motions, lengths, strict=True))
    usable = (np.minimum(*lengths) > SHORTEST) & ((seen[:, 0] * given[:, 0]).sum(axis=1) > np.cos(np.radians(WRONG)))
    return seen[usable], given[usable]


def _motions(poses):
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def _blocks(seen, given):
    """The linear equations of neighbouring steps, in blocks: [(matrix (n, 2, 3, 3), instrument, right side (n, 2, 3))].

    The instrument is the matrix of the vectors' mean over neighbouring steps.
    """
    middle = (seen + given) / 2
    pieces = max(min(BLOCKS, len(middle) // BLOCK), 1)
    matrix, instrument = _crossing(middle), _crossing(_smooth(middle))
    return [(matrix[chosen], instrument[chosen], (given - seen)[chosen])
            for chosen in np.array_split(np.arange(len(middle)), pieces) if len(chosen)]


def _crossing(vectors):
    """(..., 3, 3): what times c is c x vector."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    none = np.zeros_like(x)
    return np.stack([np.stack(row, axis=-1) for row in ((none, z, -y), (-z, none, x), (y, -x, none))], axis=-2)


def _smooth(vectors):
    """Means over NEIGHBOURS of (n, 2, 3), fewer at the ends."""
    total = np.concatenate([np.zeros((1, *vectors.shape[1:])), np.cumsum(vectors, axis=0)])
    step = np.arange(len(vectors))
    first, last = np.maximum(step - NEIGHBOURS // 2, 0), np.minimum(step + NEIGHBOURS // 2 + 1, len(vectors))
    return (total[last] - total[first]) / (last - first)[:, None, None]


def _fit(blocks, free):
    """Pitch, yaw and roll, degrees, of the Gibbs vector that fits the equations best; 0 where it is not free (3,)."""
    matrix, instrument, right = (np.concatenate(some) for some in zip(*blocks, strict=True))
    gibbs = np.zeros(3)
    for _ in range(ROUNDS):
        rest = np.linalg.norm(right - matrix @ gibbs, axis=-1)
        scale = np.maximum(np.median(rest, axis=0), 1e-9) / 1.538  # the median length of a normal vector in 3-space
        weight = np.minimum(1, HUBER * scale / np.maximum(rest, 1e-12)) / scale**2
        normal = np.einsum("nk,nkij,nkil->jl", weight, instrument, matrix)
        moments = np.einsum("nk,nkij,nki->j", weight, instrument, right)
        gibbs[free] = np.linalg.lstsq(normal[np.ix_(free, free)], moments[free], rcond=None)[0]
    length = np.linalg.norm(gibbs)
    return angles_of(cv2.Rodrigues(gibbs * (2 * np.arctan(length / 2) / max(length, 1e-12)))[0])


# What it explains

# Recording days of KITTI's sequences. The cameras were calibrated anew on each.
DAYS = {**dict.fromkeys(("00", "01", "02"), "2011-10-03"), "03": "2011-09-26",
        **{f"{number:02d}": "2011-09-30" for number in range(4, 11)}}
START = 15  # steps
STRAIGHT = 0.2  # degrees of turn in a step at the most


def explained(paths: Mapping[str, Paths]) -> pd.DataFrame:
    """What the rotation explains of each sequence's RMSE, metres: one row a sequence of {name: (estimated, true)}.

    steps; pitch, yaw, roll and their _low and _high (degrees, NaN: not determined), from the sequence itself.
    rmse: as it is. rmse_own, rmse_others: with the angles of the sequence itself, and of the `others` given here that
    were recorded on the same day (NaN where there are none).
    rotations, directions: the RMSE that is left where only the rotations, or only the directions of motion, are the
    odometry's and all else is the truth's. The angle can only mend the second; where they lean against each other,
    mending one of them makes the sum worse.
    camera_sway, truth_sway: robust standard deviation in degrees of the sideways direction of motion on straight
    steps. A car cannot slide, so the one that sways more is in error.
    start: degrees by which rotations of odometry and truth part over the first START steps. ate: metres, aligned (se3).
    """
    rows = []
    for name, (estimated, true) in paths.items():
        own = estimate([paths[name]])
        day = same_day(name, paths)
        row = {"sequence": name, "steps": own.steps}
        for index, angle in enumerate(ANGLES):
            row |= {angle: own.angles[index], f"{angle}_low": own.low[index], f"{angle}_high": own.high[index]}
        motion, given = _motions(estimated), _motions(true)
        mixed = [given.copy(), given.copy()]
        mixed[0][:, :3, :3], mixed[1][:, :3, 3] = motion[:, :3, :3], motion[:, :3, 3]
        rows.append(row | {
            "rmse": metrics.rmse(estimated, true),
            "rmse_own": metrics.rmse(turned(estimated, own.usable), true),
            "rmse_others": metrics.rmse(turned(estimated, estimate([paths[other] for other in day]).usable), true)
                           if day else np.nan,
            "others": " ".join(day), **dict(zip(("rotations", "directions"),
                                                (metrics.rmse(_composed(some, true[0]), true) for some in mixed),
                                                strict=True)),
            **_sway(motion, given), "start": _parted(motion[:START], given[:START]),
            "ate": metrics.ate(estimated, true, "se3")["rmse"]})
    return pd.DataFrame(rows)


def angles_of_day(name: str, paths: Mapping[str, Paths]) -> np.ndarray:
    """Pitch, yaw and roll, degrees, (3,), that the other sequences of a sequence's recording day give; 0 where none."""
    others = [paths[other] for other in same_day(name, paths)]
    return estimate(others).usable if others else np.zeros(3)


def same_day(name: str, names: Iterable[str]) -> list[str]:
    """Those of `names` that were recorded on the day of sequence `name`, itself left out."""
    return [other for other in names if other != name and name in DAYS and DAYS.get(other) == DAYS[name]]


def _composed(motions, start):
    poses = [start]
    for motion in motions:
        poses.append(poses[-1] @ motion)
    return np.array(poses)


def _sway(motion, given):
    length = np.linalg.norm(given[:, :3, 3], axis=1)
    straight = (length > SHORTEST) & (metrics.angles(given) < STRAIGHT)
    sideways = [np.degrees(some[straight, 0, 3] / length[straight]) for some in (motion, given)]
    return {f"{name}_sway": float(1.4826 * np.median(np.abs(some - np.median(some)))) if straight.any() else np.nan
            for name, some in zip(("camera", "truth"), sideways, strict=True)}


def _parted(motion, given):
    one, other = (_composed(some, np.eye(4))[-1][:3, :3] for some in (motion, given))
    return float(metrics.angles(one.T @ other))
