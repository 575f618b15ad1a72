"""What a keypoint is worth: how much one of a choice tells about a step's motion. No ground truth.

Statistics calls it the relative efficiency of a choice: a ratio of variances at an equal number of
observations, here estimated from random half-samples. If n keypoints give a motion with the
variance V / n, two disjoint halves of n1 and n2 of them give motions that differ by an angle of
variance V (1 / n1 + 1 / n2). So the variance of one keypoint is the median over steps and splits of
angle^2 n1 n2 / (n1 + n2), and the worth is this variance of random keypoints divided by that of the
choice.

The rule, which was fixed before the runs, and its limits are in docs/reading-results.md, the words
for its outcomes in `verdicts.WORTH`.
"""

from collections.abc import Callable, Iterable, Mapping
from functools import cache, partial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import opencv_exact
from keypoint_study import one_fit
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import (
    THESIS,
    Calls,
    Masks,
    Matches,
    Motion,
    OdometrySettings,
    metrics,
)
from thesis_repro.odometry.loop import MIN_MATCHES, normalise
from thesis_repro.odometry.refined.fit import ahead, refine, smaller_rotation
from thesis_repro.odometry.runs import check, inside
from thesis_repro.odometry.sharing import SharedCalls

SPLITS, SEED = 12, 0  # splits of each kind
FITS = 3  # draws for the measure of one fit
FIELD = 2 * THESIS.window  # side of a field, pixels
MAX_STEPS = 200  # of a sequence, at equal distances; no street of the tables has more
MIN_RANDOM = 20  # random keypoints with which even a choice of fewer is compared
NO_MOTION = 180.0  # degrees, the angle to a half without a motion
MOTIONS = ("rotation", "direction")

_RANDOM = ("", 0)  # the choice of all keypoints, from which the random ones are drawn

Choices = Mapping[tuple[str, int], tuple[OdometrySettings, Masks | None]]


class Tracks(NamedTuple):
    """N keypoints of a frame, tracked into the next one."""

    points: np.ndarray  # (N, 2), pixels
    previous: np.ndarray  # (N, 2), normalised image coordinates
    current: np.ndarray
    found: np.ndarray  # (N,) booleans
    threshold: float


def worth_of(
    sequence: Sequence,
    chosen: Choices,
    calls: Mapping[str, Calls] = {},
    splits: int | None = None,
    steps: int | None = None,
    failed: dict[tuple[str, int], str] | None = None,
) -> pd.DataFrame:
    """Return what a keypoint of each choice is worth on a sequence.

    chosen: {(name, number): (settings, masks)}, as for `odometry.run_many`; so many keypoints are
    drawn from those that the settings and the masks leave, 0 for all of them. calls: of choices
    with own keypoints, by name. splits: of each kind, SPLITS if not given. steps: at most
    so many, at equal distances, MAX_STEPS if not given. failed: gets the reasons of choices whose
    masks cannot be read, and the others go on; without it, the first such InputError is raised.

    One row a choice, number and split ("fields", "points", or ONE_FIT): sequence, choice, number,
    split, steps; keypoints, the median number that was drawn; left, the median number that the
    choice leaves; rotation and direction, the worths; rotation_deg and direction_deg, the median
    angle between two halves, or the standard deviation of one fit.
    Raises InputError if no step is long enough, and for frames or masks that cannot be read.
    """
    for _, masks in chosen.values():
        check(sequence, masks)
    long_enough = np.flatnonzero(sequence.scales[1:] >= metrics.MIN_DIRECTED_STEP)
    if not len(long_enough):
        raise InputError(
            f"sequence {sequence.name}: no step of {metrics.MIN_DIRECTED_STEP} m or more, and shorter ones "
            "do not show what a keypoint is worth"
        )
    taken = min(len(long_enough), steps or MAX_STEPS)
    indices = long_enough[np.linspace(0, len(long_enough) - 1, taken).round().astype(int)]
    repetitions = {**dict.fromkeys(SPLIT, splits or SPLITS), ONE_FIT: FITS}
    shared = SharedCalls()
    rows, failed_here = [], {} if failed is None else failed
    for index in indices:
        chosen = {key: chosen[key] for key in chosen if key not in failed_here}
        random, of_choices = tracked(sequence, int(index), chosen, shared, calls, failed)
        draws_of_random = cache(partial(_draws, random))
        for (name, number), tracks in of_choices.items():
            count = min(number or len(tracks.points), len(tracks.points))
            row = {"choice": name, "number": number, "left": len(tracks.points)}
            for split, repeats in repetitions.items():
                seeds, others = (
                    tuple((SEED, index, repeat, kind) for repeat in range(repeats))
                    for kind in (0, 1)
                )
                draws = _draws(tracks, count, split, seeds)
                references = draws_of_random(max(count, MIN_RANDOM), split, others)
                for draw, reference in zip(draws, references, strict=True):
                    of_random = {f"random_{name}": value for name, value in reference.items()}
                    rows.append({**row, "split": split, **draw, **of_random})
    if failed and not rows:
        raise InputError(next(iter(failed.values())))
    medians = pd.DataFrame(rows).groupby(["choice", "number", "split"], sort=False).median()
    for name in MOTIONS:
        medians[name] = medians[f"random_{name}_variance"] / medians[f"{name}_variance"]
    table = medians[
        ["keypoints", "left", *MOTIONS, *(f"{name}_deg" for name in MOTIONS)]
    ].reset_index()
    table.insert(0, "sequence", sequence.name)
    table.insert(4, "steps", len(indices))
    return table


def tracked(
    sequence: Sequence,
    index: int,
    chosen: Choices,
    shared: SharedCalls,
    calls: Mapping[str, Calls],
    failed: dict[tuple[str, int], str] | None = None,
) -> tuple[Tracks, dict[tuple[str, int], Tracks]]:
    """Return all keypoints of frame `index`, and those of each choice, tracked into the next.

    failed: see `worth_of`.
    """
    frame, following = sequence.frame(index), sequence.frame(index + 1)
    frame.setflags(write=False)  # so that all choices share it
    visible = sequence.visible(index)
    made: dict[int, Any] = {id(None): None}
    everything = {_RANDOM: (THESIS, None), **chosen}
    points = {}
    masks: Any
    for key, (settings, masks) in everything.items():
        detect = calls.get(key[0], shared.calls).detect
        try:
            if id(masks) not in made:
                made[id(masks)] = masks[index]
            points[key] = detect(frame, settings, inside(visible, made[id(masks)]))
        except InputError as error:
            if failed is None:
                raise
            failed[key] = str(error)
    # those of all choices, at once
    shared.expect(following, [SimpleNamespace(points=p, previous=frame) for p in points.values()])
    tracks = {}
    for key, detected in points.items():
        settings, _ = everything[key]
        moved, found = detected, np.zeros(0, bool)
        if len(detected):
            track = calls.get(key[0], shared.calls).track
            moved, found = track(frame, following, detected, settings)
        before, now = (normalise(pixels, sequence.intrinsics) for pixels in (detected, moved))
        tracks[key] = Tracks(detected, before, now, found, settings.threshold)
    return tracks.pop(_RANDOM), tracks


def _draws(
    tracks: Tracks, count: int, split: str, seeds: Iterable[tuple[int, ...]]
) -> list[dict[str, float]]:
    """Draw keypoints for each seed, divide them, and return how far their halves' motions differ.

    Or, for ONE_FIT, how uncertain the motion of all of them is. One a seed:
    {keypoints; rotation_deg, direction_deg: angles; rotation_variance, direction_variance: of one
    keypoint, degrees^2}
    """
    draws: list[dict[str, float]] = []
    pairs, weights = [], []
    for seed in seeds:
        random = np.random.default_rng(seed)
        drawn = random.permutation(len(tracks.points))[:count]
        if split == ONE_FIT:
            draws.append(_one_fit(tracks, drawn))
            continue
        in_first = SPLIT[split](tracks.points[drawn], random)
        first, second = drawn[in_first], drawn[~in_first]
        pairs.append((refined_motion(tracks, first), refined_motion(tracks, second)))
        draws.append({"keypoints": len(drawn)})
        weights.append(max(len(first) * len(second), 1) / max(len(drawn), 1))
    for draw, weight, angles in zip(draws, weights, _angles(pairs)):
        for motion, angle in zip(MOTIONS, angles, strict=True):
            draw |= {f"{motion}_deg": angle, f"{motion}_variance": angle**2 * weight}
    return draws


def _one_fit(tracks: Tracks, drawn: np.ndarray) -> dict[str, float]:
    """Return what `_halves` returns, from the covariance of the motion of all drawn keypoints."""
    variances = NO_MOTION**2, NO_MOTION**2
    motion, found = refined_motion(tracks, drawn), drawn[tracks.found[drawn]]
    if motion is not None:
        matches = Matches(tracks.current[found], tracks.previous[found], tracks.threshold)
        fields = _numbered(tracks.points[found] // FIELD)
        variances = one_fit.variances(motion, matches, fields)
    numbers: dict[str, float] = {"keypoints": len(drawn)}
    for name, variance in zip(MOTIONS, variances, strict=True):
        variance = min(variance, NO_MOTION**2)
        numbers |= {f"{name}_deg": variance**0.5, f"{name}_variance": variance * max(len(drawn), 1)}
    return numbers


def _by_fields(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Which of N keypoints (N, 2) are in the first half, (N,) booleans: half of the fields."""
    field = _numbered(np.floor((points + random.uniform(0, FIELD, 2)) / FIELD))
    return _by_points(np.arange(field.max(initial=-1) + 1), random)[field]


def _numbered(fields: np.ndarray) -> np.ndarray:
    """The number of each field among those that occur, (N,), of columns and rows of fields (N, 2).

    They are sorted as one number each, which is faster than in pairs.
    """
    _, number = np.unique(fields @ (2.0**16, 1.0), return_inverse=True)
    return number


def _by_points(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Which of N keypoints are in the first half, (N,) booleans."""
    return random.permutation(len(points)) < len(points) / 2


SPLIT: dict[str, Callable] = {"fields": _by_fields, "points": _by_points}
ONE_FIT = "fit"  # in place of a split: the second measure (one_fit.py)


def refined_motion(tracks: Tracks, indices: np.ndarray) -> Motion | None:
    """Return the refined motion of some keypoints; None if they give none."""
    indices = indices[tracks.found[indices]]
    if len(indices) < MIN_MATCHES:
        return None
    current, previous = tracks.current[indices], tracks.previous[indices]
    matrix, inliers = opencv_exact.find_essential_matrix(
        current, previous, threshold=tracks.threshold
    )
    if matrix is None or inliers is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None
    matches = Matches(current, previous, tracks.threshold, inliers.ravel() > 0)
    rotation, heading, support = refine(*smaller_rotation(matrix), matches)
    return Motion(rotation, *ahead(rotation, heading, support, tracks.threshold))


def _angles(pairs: list[tuple[Motion | None, Motion | None]]) -> list[list[float]]:
    """Return the angles (degrees) between the rotations and the directions of pairs of motions."""
    angles = np.full((len(pairs), 2), NO_MOTION)
    known = [(k, *pair) for k, pair in enumerate(pairs) if None not in pair]
    if known:
        places, first, second = zip(*known)
        both = list(zip(first, second))
        turns = np.array([a.rotation.T @ b.rotation for a, b in both])
        crosses = np.cross([a.translation for a in first], [b.translation for b in second])
        sines = [np.linalg.norm(each) for each in crosses]
        cosines = [a.translation @ b.translation for a, b in both]
        angles[places, 0] = metrics.angles(turns)
        angles[places, 1] = np.degrees(np.arctan2(sines, cosines))
    return angles.tolist()
