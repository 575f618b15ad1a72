"""The boresight: the constant rotation between the odometry's camera and the frame of the ground
truth (audit row 30).

Axes are those of KITTI's camera: x right, y down, z forward. The rotation B takes a direction from
the camera to the frame of the ground truth: d_true = B d_camera. Its three angles are in degrees
and follow the right-hand rule: B = R_y(yaw) R_x(pitch) R_z(roll). A positive yaw turns the forward
axis to the right, a positive pitch turns it up, and a positive roll turns the right axis down.

A relative motion M of the camera is B M B^T in the frame of the ground truth. Lengths come from the
ground truth, so they do not change. A path that starts at P0 has P0 B P0^-1 P B^T in place of each
pose P. `corrected` applies this to a finished run, so the odometry need not run again.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation
from scipy.special import stdtrit

from thesis_repro import InputError
from thesis_repro.odometry import metrics

ANGLES = ("pitch", "yaw", "roll")
MIN_STEP = 0.3  # metres; noise hides the direction of motion of shorter steps
# degrees; an estimated step farther from the ground truth has failed and is left out
MAX_HEADING_ERROR = 20.0
HUBER = 1.345  # standard deviations beyond which a residual counts linearly
REWEIGHTINGS = 10
SMOOTHED_STEPS = 9  # long enough to average out noise, shorter than a turn
MIN_BLOCK_STEPS = 20  # of a bootstrap block: the errors of neighbouring steps are correlated
MAX_BLOCKS = 8  # in a sequence
BOOTSTRAP_DRAWS = 200
MAX_HALF_INTERVAL = 1.0  # degrees; an angle with a wider interval is not determined
# estimated and ground-truth poses of one sequence, (n, 4, 4) each
Paths = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Boresight:
    """Angles (pitch, yaw, roll) and their 95 % intervals in degrees, (3,) each, and the number of
    steps used.

    An angle that is not determined is NaN: roll if the car never turns, all angles if there are too
    few steps.
    """

    angles: np.ndarray
    low: np.ndarray
    high: np.ndarray
    steps: int

    @property
    def usable(self) -> np.ndarray:
        """Angles to apply (3,): 0 for an angle that is not determined."""
        return np.nan_to_num(self.angles)


def rotation(angles: Iterable[float]) -> np.ndarray:
    """B (3x3) from pitch, yaw and roll in degrees. Raises InputError if one is not finite."""
    pitch, yaw, roll = angles
    if not np.isfinite((pitch, yaw, roll)).all():
        raise InputError(
            f"boresight {pitch} {yaw} {roll}: give pitch, yaw and roll in degrees, 0 if unknown"
        )
    return Rotation.from_euler("YXZ", (yaw, pitch, roll), degrees=True).as_matrix()


def corrected(poses: np.ndarray, angles: Iterable[float]) -> np.ndarray:
    """Path (n, 4, 4) with each relative motion turned by B and the same first pose."""
    b = np.eye(4)
    b[:3, :3] = rotation(angles)
    return poses[0] @ b @ np.linalg.inv(poses[0]) @ poses @ b.T


def estimate(paths: Sequence[Paths]) -> Boresight:
    """Estimate B from the (estimated, ground-truth) poses, (n, 4, 4) each, of one or more
    sequences.

    Each step gives two vectors that differ by B in the two paths: the direction of motion and the
    rotation vector. For vectors s and B s, B s - s = c x (B s + s) / 2 exactly, with the Gibbs
    vector c = 2 tan(angle / 2) axis of B. These equations are linear in c. They are solved with
    Huber's weights and instrumental variables: the vectors' means over neighbouring steps. Plain
    least squares would be biased towards zero angles by the noise of each step's vectors.

    The 95 % intervals come from a bootstrap over blocks of neighbouring steps, widened by Student's
    t for few blocks. They do not cover errors that a whole drive has in common. While an angle is
    not determined, the angle with the widest interval is left out.
    """
    blocks = [block for path in paths for block in _equation_blocks(*_vectors(*path))]
    steps = sum(len(right) for _, right, _, _ in blocks)
    if len(blocks) < 2:
        undetermined = np.full(3, np.nan)
        return Boresight(undetermined, undetermined, undetermined, steps)
    free = np.ones(3, bool)
    best, reach = _with_interval(blocks, free)
    while reach.max() > MAX_HALF_INTERVAL:  # an undetermined angle must not change the others
        free[reach.argmax()] = False
        best, reach = _with_interval(blocks, free)
    angles, low, high = (
        np.where(free, values, np.nan) for values in (best, best - reach, best + reach)
    )
    return Boresight(angles, low, high, steps)


def _motions(poses):
    return np.linalg.inv(poses[:-1]) @ poses[1:]


def _vectors(estimated, true):
    """Unit directions and rotation vectors of the usable steps: (n, 2, 3) of the camera and of
    the ground truth.
    """
    estimated, true = metrics.checked(estimated, true)
    motions = _motions(estimated), _motions(true)
    lengths = [np.linalg.norm(steps[:, :3, 3], axis=1) for steps in motions]
    seen, given = (
        np.stack(
            [
                steps[:, :3, 3] / np.maximum(length, 1e-9)[:, None],
                Rotation.from_matrix(steps[:, :3, :3]).as_rotvec(),
            ],
            axis=1,
        )
        for steps, length in zip(motions, lengths, strict=True)
    )
    cosine = (seen[:, 0] * given[:, 0]).sum(axis=1)
    usable = (np.minimum(*lengths) > MIN_STEP) & (cosine > np.cos(np.radians(MAX_HEADING_ERROR)))
    return seen[usable], given[usable]


def _equation_blocks(seen, given):
    """Equations of one sequence in blocks of neighbouring steps: (matrix, right, normal, moments)
    of each block.

    matrix @ c = right for each step and vector, (n, 2, 3, 3) and (n, 2, 3). normal @ c = moments is
    the same equation multiplied by the transposed instrument.
    """
    middle, right = (seen + given) / 2, given - seen
    matrix, instrument = _cross_matrices(middle), _cross_matrices(_smooth(middle))
    transposed = instrument.swapaxes(-1, -2)
    equations = matrix, right, transposed @ matrix, (transposed @ right[..., None])[..., 0]
    count = max(min(MAX_BLOCKS, len(middle) // MIN_BLOCK_STEPS), 1)
    return (
        list(zip(*(np.array_split(part, count) for part in equations), strict=True))
        if len(middle)
        else []
    )


def _cross_matrices(vectors):
    """Matrices (..., 3, 3) with matrix @ c = c x vector."""
    return np.cross(np.eye(3), vectors[..., None, :]).swapaxes(-1, -2)


def _smooth(vectors):
    """Moving averages (n, 2, 3) over SMOOTHED_STEPS, or fewer at the ends."""
    total = np.concatenate([np.zeros((1, *vectors.shape[1:])), np.cumsum(vectors, axis=0)])
    step = np.arange(len(vectors))
    first, last = (
        np.maximum(step - SMOOTHED_STEPS // 2, 0),
        np.minimum(step + SMOOTHED_STEPS // 2 + 1, len(vectors)),
    )
    return (total[last] - total[first]) / (last - first)[:, None, None]


def _with_interval(blocks, free):
    """Best angles (0 where not free) and the half widths of their intervals, degrees."""
    random, count = np.random.default_rng(0), len(blocks)
    drawn = [
        _fit([blocks[index] for index in random.integers(0, count, count)], free)
        for _ in range(BOOTSTRAP_DRAWS)
    ]
    widening = np.sqrt(count / (count - 1)) * stdtrit(count - 1, 0.975)
    return _fit(blocks, free), np.std(drawn, axis=0) * widening


def _fit(blocks, free):
    """Pitch, yaw and roll (degrees) that fit the steps of the blocks best; entries of c that
    are not free are 0.
    """
    matrix, right, normal, moments = (np.concatenate(part) for part in zip(*blocks, strict=True))
    gibbs = np.zeros(3)
    for _ in range(REWEIGHTINGS):
        residual = right - (matrix.reshape(-1, 3) @ gibbs).reshape(right.shape)
        size = np.sqrt((residual * residual).sum(axis=-1))
        # median length of a standard normal vector (3)
        scale = np.maximum(np.median(size, axis=0), 1e-9) / 1.538
        weight = np.minimum(1, HUBER * scale / np.maximum(size, 1e-12)) / scale**2
        left, goal = (np.tensordot(weight, part, axes=2) for part in (normal, moments))
        gibbs[free] = np.linalg.lstsq(left[np.ix_(free, free)], goal[free], rcond=None)[0]
    yaw, pitch, roll = Rotation.from_quat([*gibbs / 2, 1.0]).as_euler("YXZ", degrees=True)
    return np.array([pitch, yaw, roll])


# Effect on the errors

# Recording days of KITTI's sequences. The cameras were calibrated again on each day.
DAYS = {
    **dict.fromkeys(("00", "01", "02"), "2011-10-03"),
    "03": "2011-09-26",
    **{f"{number:02d}": "2011-09-30" for number in range(4, 11)},
}
MAX_STRAIGHT_TURN = 0.2  # degrees; a step that turns more is not straight


def explained(paths: Mapping[str, Paths]) -> pd.DataFrame:
    """RMSE (metres) with and without the boresight, one row for each sequence of {name: (estimated,
    ground truth)}.

    steps; pitch, yaw, roll and their _low and _high: estimated from the sequence itself (degrees,
    NaN: not determined).
    rmse: without correction. rmse_own: with the sequence's own angles. rmse_others: with the angles
    of `others`, the other sequences of the same recording day (NaN if there are none).
    camera_sway, truth_sway: robust standard deviation (degrees) of the sideways direction of motion
    on straight steps. A car cannot slide sideways, so the path with the larger sway is in error.
    """
    rows = []
    for name, (estimated, true) in paths.items():
        own = estimate([paths[name]])
        others = same_day(name, paths)
        motion, given = _motions(estimated), _motions(true)
        row = {"sequence": name, "steps": own.steps}
        for angle, *values in zip(ANGLES, own.angles, own.low, own.high, strict=True):
            row |= dict(zip((angle, f"{angle}_low", f"{angle}_high"), values, strict=True))
        rows.append(
            row
            | {
                "rmse": metrics.rmse(estimated, true),
                "rmse_own": metrics.rmse(corrected(estimated, own.usable), true),
                "rmse_others": metrics.rmse(corrected(estimated, angles_of_day(name, paths)), true)
                if others
                else np.nan,
                "others": " ".join(others),
                "camera_sway": _sway(motion, given),
                "truth_sway": _sway(given, given),
            }
        )
    return pd.DataFrame(rows)


def angles_of_day(name: str, paths: Mapping[str, Paths]) -> np.ndarray:
    """Pitch, yaw and roll (3,) in degrees from the other sequences of the same recording day; 0
    if there are none.
    """
    others = [paths[other] for other in same_day(name, paths)]
    return estimate(others).usable if others else np.zeros(3)


def same_day(name: str, names: Iterable[str]) -> list[str]:
    """Names of the other sequences that were recorded on the same day as sequence `name`."""
    return [
        other for other in names if other != name and name in DAYS and DAYS.get(other) == DAYS[name]
    ]


def _sway(motion, true_motion):
    """Robust standard deviation (degrees) of the sideways direction of motion on straight steps."""
    length = np.linalg.norm(true_motion[:, :3, 3], axis=1)
    straight = (length > MIN_STEP) & (metrics.angles(true_motion) < MAX_STRAIGHT_TURN)
    if not straight.any():
        return np.nan
    sideways = np.degrees(motion[straight, 0, 3] / length[straight])
    return float(1.4826 * np.median(np.abs(sideways - np.median(sideways))))
