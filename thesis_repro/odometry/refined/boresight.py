"""The boresight: the constant rotation between the odometry's camera and the frame of the true poses (audit row 30).

Directions are those of KITTI's camera: x right, y down, z forward. A rotation B takes a direction as the camera sees it
to the same direction in the frame of the true poses, d_true = B d_camera. It is written as three angles in degrees,
each turning by the right-hand rule: B = R_y(yaw) R_x(pitch) R_z(roll). So a positive yaw moves what is ahead to the
right, a positive pitch moves it up, a positive roll moves what is right down.

Every relative motion M of the camera is B M B^T in the frame of the true poses. Lengths are taken from the truth here.
So turning all motions by B gives P0 B P0^-1 P B^T for each pose P of a path that starts at P0: `corrected` applies that
to a finished run, and needs no other one.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from thesis_repro import InputError
from thesis_repro.odometry import metrics

ANGLES = ("pitch", "yaw", "roll")
MIN_STEP = 0.3  # metres: in a shorter step the direction of motion is lost in noise
MAX_HEADING_ERROR = 20.0  # degrees between both directions of a step: with more, it has failed and is left out
HUBER = 1.345  # standard deviations beyond which a residual counts linearly
REWEIGHTINGS = 10
SMOOTHED_STEPS = 9  # long enough to average noise out, shorter than a turn
MIN_BLOCK_STEPS = 20  # drawn together, because errors of neighbouring steps are correlated
MAX_BLOCKS = 8  # of a sequence
BOOTSTRAP_DRAWS = 200
MAX_HALF_INTERVAL = 1.0  # degrees: an angle whose interval reaches farther to either side is not determined
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
    """B, 3x3, of pitch, yaw and roll in degrees. Raises InputError where one is no number."""
    pitch, yaw, roll = angles
    if not np.isfinite((pitch, yaw, roll)).all():
        raise InputError(f"boresight {pitch} {yaw} {roll}: pitch, yaw and roll must be numbers of degrees; 0 for one "
                         "that is not known")
    return Rotation.from_euler("YXZ", (yaw, pitch, roll), degrees=True).as_matrix()


def corrected(poses: np.ndarray, angles: Iterable[float]) -> np.ndarray:
    """The path (n, 4, 4) with every relative motion turned by B; its first pose stays."""
    b = np.eye(4)
    b[:3, :3] = rotation(angles)
    return poses[0] @ b @ np.linalg.inv(poses[0]) @ poses @ b.T


def estimate(paths: Sequence[Paths]) -> Boresight:
    """The rotation between both frames from one or more sequences: (estimated, true) poses, (n, 4, 4) each.

    Two kinds of vectors of a step must agree up to B: its direction of motion, and its rotation vector, whose axis
    shows in turns. For vectors s and B s exactly, B s - s = c x (B s + s) / 2 with the Gibbs vector c = 2 tan(angle/2)
    axis of B: linear in c, and solved with Huber's weights, each kind measured by its own robust standard deviation.
    The vectors' means over neighbouring steps serve as instruments: least squares would take each step's own noise,
    which is at right angles to c x noise, for a proof that the angles are zero.

    Intervals, 95 %: bootstrap over blocks of neighbouring steps, widened by Student's t where blocks are few. They hold
    what varies within the sequences, not what is common to all of a drive. The angle with the widest interval is left
    out, one at a time, until the others are determined.
    """
    equations = _equations([_vectors(*path) for path in paths])
    nothing = np.full(3, np.nan)
    if len(equations.blocks) < 2:
        return Boresight(nothing, nothing, nothing, len(equations.right))
    known = np.ones(3, bool)
    best, reach = _with_interval(equations, known)
    while reach.max() > MAX_HALF_INTERVAL:  # an angle that may be anything must not change the others
        known[reach.argmax()] = False
        best, reach = _with_interval(equations, known)
    angles, low, high = (np.where(known, values, np.nan) for values in (best, best - reach, best + reach))
    return Boresight(angles, low, high, len(equations.right))


def _motions(poses):
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def _vectors(estimated, true):
    """Directions and rotation vectors of the usable steps, (n, 2, 3) each: as the camera sees them, and in truth."""
    estimated, true = metrics.checked(estimated, true)
    motions = _motions(estimated), _motions(true)
    lengths = [np.linalg.norm(steps[:, :3, 3], axis=1) for steps in motions]
    seen, given = (np.stack([steps[:, :3, 3] / np.maximum(length, 1e-9)[:, None],
                             Rotation.from_matrix(steps[:, :3, :3]).as_rotvec()], axis=1)
                   for steps, length in zip(motions, lengths, strict=True))
    cosine = (seen[:, 0] * given[:, 0]).sum(axis=1)
    usable = (np.minimum(*lengths) > MIN_STEP) & (cosine > np.cos(np.radians(MAX_HEADING_ERROR)))
    return seen[usable], given[usable]


class _Equations(NamedTuple):
    """For each step and kind of vector: matrix @ c = right, and the products of both with the transposed instrument."""

    matrix: np.ndarray  # (n, 2, 3, 3)
    right: np.ndarray  # (n, 2, 3)
    normal: np.ndarray  # (n, 2, 3, 3)
    moments: np.ndarray  # (n, 2, 3)
    blocks: list[np.ndarray]  # indices of neighbouring steps


def _equations(vectors):
    parts, blocks, first = [], [], 0
    for seen, given in vectors:
        middle = (seen + given) / 2
        matrix, instrument = _cross_matrices(middle), _cross_matrices(_smooth(middle))
        transposed = instrument.swapaxes(-1, -2)
        parts.append((matrix, given - seen, transposed @ matrix, (transposed @ (given - seen)[..., None])[..., 0]))
        pieces = max(min(MAX_BLOCKS, len(middle) // MIN_BLOCK_STEPS), 1)
        blocks += [block for block in np.array_split(np.arange(first, first + len(middle)), pieces) if len(block)]
        first += len(middle)
    matrix, right, normal, moments = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Equations(matrix, right, normal, moments, blocks)


def _cross_matrices(vectors):
    """(..., 3, 3): what times c is c x vector."""
    return np.cross(np.eye(3), vectors[..., None, :]).swapaxes(-1, -2)


def _smooth(vectors):
    """Means over SMOOTHED_STEPS of (n, 2, 3), fewer at the ends."""
    total = np.concatenate([np.zeros((1, *vectors.shape[1:])), np.cumsum(vectors, axis=0)])
    step = np.arange(len(vectors))
    first, last = np.maximum(step - SMOOTHED_STEPS // 2, 0), np.minimum(step + SMOOTHED_STEPS // 2 + 1, len(vectors))
    return (total[last] - total[first]) / (last - first)[:, None, None]


def _with_interval(equations, free):
    """The best angles, those that are not free being 0, and how far their intervals reach to either side."""
    random, count = np.random.default_rng(0), len(equations.blocks)
    drawn = [_fit(equations, [equations.blocks[index] for index in random.integers(0, count, count)], free)
             for _ in range(BOOTSTRAP_DRAWS)]
    widening = np.sqrt(count / (count - 1)) * stdtrit(count - 1, 0.975)
    return _fit(equations, equations.blocks, free), np.std(drawn, axis=0) * widening


def _fit(equations, blocks, free):
    """Pitch, yaw and roll, degrees, of the Gibbs vector that fits the blocks best; 0 where it is not free (3,)."""
    steps = np.concatenate(blocks)
    matrix, right, normal, moments = (part[steps] for part in equations[:4])
    gibbs = np.zeros(3)
    for _ in range(REWEIGHTINGS):
        residual = right - (matrix.reshape(-1, 3) @ gibbs).reshape(right.shape)
        size = np.sqrt((residual * residual).sum(axis=-1))
        scale = np.maximum(np.median(size, axis=0), 1e-9) / 1.538  # the median length of a normal vector in 3-space
        weight = np.minimum(1, HUBER * scale / np.maximum(size, 1e-12)) / scale**2
        left, goal = (np.tensordot(weight, part, axes=2) for part in (normal, moments))
        gibbs[free] = np.linalg.lstsq(left[np.ix_(free, free)], goal[free], rcond=None)[0]
    yaw, pitch, roll = Rotation.from_quat([*gibbs / 2, 1.0]).as_euler("YXZ", degrees=True)
    return np.array([pitch, yaw, roll])


# What it explains

# Recording days of KITTI's sequences. The cameras were calibrated anew on each.
DAYS = {**dict.fromkeys(("00", "01", "02"), "2011-10-03"), "03": "2011-09-26",
        **{f"{number:02d}": "2011-09-30" for number in range(4, 11)}}
MAX_STRAIGHT_TURN = 0.2  # degrees of turn in a straight step


def explained(paths: Mapping[str, Paths]) -> pd.DataFrame:
    """What the rotation explains of each sequence's RMSE, metres: one row a sequence of {name: (estimated, true)}.

    steps; pitch, yaw, roll and their _low and _high (degrees, NaN: not determined), from the sequence itself.
    rmse: as it is. rmse_own, rmse_others: with the angles of the sequence itself, and of the `others` given here that
    were recorded on the same day (NaN where there are none).
    camera_sway, truth_sway: robust standard deviation in degrees of the sideways direction of motion on straight
    steps. A car cannot slide, so the one that sways more is in error.
    """
    rows = []
    for name, (estimated, true) in paths.items():
        own = estimate([paths[name]])
        others = same_day(name, paths)
        motion, given = _motions(estimated), _motions(true)
        row = {"sequence": name, "steps": own.steps}
        for angle, *values in zip(ANGLES, own.angles, own.low, own.high, strict=True):
            row |= dict(zip((angle, f"{angle}_low", f"{angle}_high"), values, strict=True))
        rows.append(row | {
            "rmse": metrics.rmse(estimated, true),
            "rmse_own": metrics.rmse(corrected(estimated, own.usable), true),
            "rmse_others": metrics.rmse(corrected(estimated, angles_of_day(name, paths)), true) if others else np.nan,
            "others": " ".join(others), "camera_sway": _sway(motion, given), "truth_sway": _sway(given, given)})
    return pd.DataFrame(rows)


def angles_of_day(name: str, paths: Mapping[str, Paths]) -> np.ndarray:
    """Pitch, yaw and roll, degrees, (3,), that the other sequences of a sequence's recording day give; 0 where none."""
    others = [paths[other] for other in same_day(name, paths)]
    return estimate(others).usable if others else np.zeros(3)


def same_day(name: str, names: Iterable[str]) -> list[str]:
    """Those of `names` that were recorded on the day of sequence `name`, itself left out."""
    return [other for other in names if other != name and name in DAYS and DAYS.get(other) == DAYS[name]]


def _sway(motion, true_motion):
    """Robust standard deviation, degrees, of the sideways direction of motion over straight steps."""
    length = np.linalg.norm(true_motion[:, :3, 3], axis=1)
    straight = (length > MIN_STEP) & (metrics.angles(true_motion) < MAX_STRAIGHT_TURN)
    if not straight.any():
        return np.nan
    sideways = np.degrees(motion[straight, 0, 3] / length[straight])
    return float(1.4826 * np.median(np.abs(sideways - np.median(sideways))))
