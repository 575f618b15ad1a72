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

from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from itertools import chain, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

import opencv_exact
from keypoint_study import jobs, one_fit, ratios, verdicts
from keypoint_study.methods import METHODS, changed
from keypoint_study.runner import TABLES, reader_of, record_of
from keypoint_study.sources import UNMASKED, Source, own_calls
from keypoint_study.verdicts import verdict
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError, cause
from thesis_repro.odometry import (
    THESIS,
    Calls,
    Masks,
    Matches,
    Motion,
    OdometrySettings,
    metrics,
)
from thesis_repro.odometry.keypoints import filled, spread
from thesis_repro.odometry.loop import MIN_MATCHES, normalise
from thesis_repro.odometry.refined.fit import RefinedMotion, fit, smaller_rotation
from thesis_repro.odometry.runs import check, inside
from thesis_repro.odometry.sharing import SharedCalls
from thesis_repro.running import program, provenance
from thesis_repro.running.code_used import digest_of_code
from thesis_repro.running.files import progress
from thesis_repro.running.workers import open_pool

NUMBERS = (100, 200, 400)
DECIDING = 400  # keypoints
SPLITS, SEED = 12, 0  # splits of each kind
FITS = 3  # draws for the measure of one fit
FIELD = 2 * THESIS.window  # side of a field, pixels
MAX_STEPS = 200  # of a sequence, at equal distances; no street of the tables has more
MIN_RANDOM = 20  # random keypoints with which even a choice of fewer is compared
NO_MOTION = 180.0  # degrees, the angle to a half without a motion
FILL = 5  # keypoints in each of 16 x 5 fields of the frame, for masks that are filled
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
) -> pd.DataFrame:
    """Return what a keypoint of each choice is worth on a sequence.

    chosen: {(name, number): (settings, masks)}, as for `odometry.run_many`; so many keypoints are
    drawn from those that the settings and the masks leave, 0 for all of them. calls: of choices
    with own keypoints, by name. splits: of each kind, SPLITS if not given. steps: at most
    so many, at equal distances, MAX_STEPS if not given.

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
    shared = SharedCalls()
    rows = []
    for index in indices:
        random, of_choices = tracked(sequence, int(index), chosen, shared, calls)
        halves_of_random = cache(partial(_halves, random))
        for (name, number), tracks in of_choices.items():
            count = min(number or len(tracks.points), len(tracks.points))
            for split, repeat in chain(
                product(SPLIT, range(splits or SPLITS)), product([ONE_FIT], range(FITS))
            ):
                halves = _halves(tracks, count, split, (SEED, index, repeat, 0))
                reference = halves_of_random(
                    max(count, MIN_RANDOM), split, (SEED, index, repeat, 1)
                )
                row = {"choice": name, "number": number, "split": split, "left": len(tracks.points)}
                row |= halves
                rows.append(row | {f"random_{name}": value for name, value in reference.items()})
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
) -> tuple[Tracks, dict[tuple[str, int], Tracks]]:
    """Return all keypoints of frame `index`, and those of each choice, tracked into the next."""
    frame, following = sequence.frame(index), sequence.frame(index + 1)
    frame.setflags(write=False)  # so that all choices share it
    visible = sequence.visible(index)
    made = {id(masks): masks[index] for _, masks in chosen.values() if masks is not None}
    everything = {_RANDOM: (THESIS, None), **chosen}
    points = {}
    for key, (settings, masks) in everything.items():
        detect = calls.get(key[0], shared.calls).detect
        points[key] = detect(frame, settings, inside(visible, made.get(id(masks))))
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


def _halves(tracks: Tracks, count: int, split: str, seed: tuple[int, ...]) -> dict[str, float]:
    """Draw keypoints, divide them, and return how far the motions of both halves are apart.

    Or, for ONE_FIT, how uncertain the motion of all of them is.
    {keypoints; rotation_deg, direction_deg: angles; rotation_variance, direction_variance: of one
    keypoint, degrees^2}
    """
    random = np.random.default_rng(seed)
    drawn = random.permutation(len(tracks.points))[:count]
    if split == ONE_FIT:
        return _one_fit(tracks, drawn)
    in_first = SPLIT[split](tracks.points[drawn], random)
    first, second = drawn[in_first], drawn[~in_first]
    angles = _angles(refined_motion(tracks, first), refined_motion(tracks, second))
    weight = max(len(first) * len(second), 1) / max(len(drawn), 1)
    numbers: dict[str, float] = {"keypoints": len(drawn)}
    for motion, angle in zip(MOTIONS, angles, strict=True):
        numbers |= {f"{motion}_deg": angle, f"{motion}_variance": angle**2 * weight}
    return numbers


def _one_fit(tracks: Tracks, drawn: np.ndarray) -> dict[str, float]:
    """Return what `_halves` returns, from the covariance of the motion of all drawn keypoints."""
    variances = NO_MOTION**2, NO_MOTION**2
    motion, found = refined_motion(tracks, drawn), drawn[tracks.found[drawn]]
    if motion is not None:
        matches = Matches(tracks.current[found], tracks.previous[found], tracks.threshold)
        _, fields = np.unique(tracks.points[found] // FIELD, axis=0, return_inverse=True)
        variances = one_fit.variances(motion, matches, fields.ravel())
    numbers: dict[str, float] = {"keypoints": len(drawn)}
    for name, variance in zip(MOTIONS, variances, strict=True):
        variance = min(variance, NO_MOTION**2)
        numbers |= {f"{name}_deg": variance**0.5, f"{name}_variance": variance * max(len(drawn), 1)}
    return numbers


def _by_fields(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Which of N keypoints (N, 2) are in the first half, (N,) booleans: half of the fields."""
    fields = np.floor((points + random.uniform(0, FIELD, 2)) / FIELD)
    _, field = np.unique(fields, axis=0, return_inverse=True)
    return _by_points(np.arange(field.max(initial=-1) + 1), random)[field.ravel()]


def _by_points(points: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Which of N keypoints are in the first half, (N,) booleans."""
    return random.permutation(len(points)) < len(points) / 2


SPLIT: dict[str, Callable] = {"fields": _by_fields, "points": _by_points}
ONE_FIT = "fit"  # in place of a split: the second measure (one_fit.py)


def refined_motion(tracks: Tracks, indices: np.ndarray) -> RefinedMotion | None:
    """Return the refined motion of some keypoints; None if they give none."""
    indices = indices[tracks.found[indices]]
    if len(indices) < MIN_MATCHES:
        return None
    current, previous = tracks.current[indices], tracks.previous[indices]
    matrix, inliers = opencv_exact.find_essential_matrix(current, previous, tracks.threshold)
    if matrix is None or inliers is None or matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None
    matches = Matches(current, previous, tracks.threshold, inliers.ravel() > 0)
    return fit(*smaller_rotation(matrix), matches)


def _angles(first: Motion | None, second: Motion | None) -> tuple[float, float]:
    """Return the angles (degrees) between the rotations and the directions of two motions."""
    if first is None or second is None:
        return NO_MOTION, NO_MOTION
    rotation = metrics.angles(first.rotation.T @ second.rotation)
    sine = np.linalg.norm(np.cross(first.translation, second.translation))
    direction = np.degrees(np.arctan2(sine, first.translation @ second.translation))
    return float(rotation), float(direction)


# The choices of a study


def choices_of(
    sequence: Sequence,
    sources: Iterable[Source],
    width: int | None,
    numbers: Iterable[int] = (DECIDING,),
    with_controls: bool = True,
    masked_settings: Mapping[str, Any] = {},
    named: Collection[str] = (),
) -> Choices:
    """Return the choices of a study for `worth_of`.

    numbers: see `worth_of`. Random and spread keypoints, masks and own keypoints have each of them,
    the other choices only DECIDING. with_controls: also masks that are filled, and the controls of
    `jobs.mask_controls`; named: see there.
    """
    chosen: dict[tuple[str, int], tuple] = {}
    for number in numbers:
        chosen["random keypoints", number] = THESIS, None
        if number:
            chosen["spread keypoints", number] = replace(THESIS, detector=spread(number)), None
    chosen["strongest keypoints", DECIDING] = replace(THESIS, max_keypoints=DECIDING), None
    masked = replace(THESIS, **masked_settings)
    for source in sources:
        prefix = f"{source.name}: " if source.name else ""
        if source.kind == "keypoints":
            chosen |= {(source.name, number): (THESIS, None) for number in numbers}
        if source.kind in UNMASKED:
            continue
        masks = source.masks(sequence, width)
        chosen |= {(f"{prefix}masks", number): (masked, masks) for number in numbers}
        strongest = replace(masked, max_keypoints=DECIDING)
        chosen[f"{prefix}strongest on the masks", DECIDING] = strongest, masks
        if with_controls:
            more = replace(masked, detector=filled(FILL, masked.detector))
            chosen[f"{prefix}masks, filled", DECIDING] = more, masks
            controls = jobs.mask_controls(source, sequence, width, named)
            for name, width_of_control in controls.items():
                settings, control = METHODS[name].choose(sequence, source, width_of_control)
                settings = changed(settings, masked_settings)
                chosen[prefix + METHODS[name].title, DECIDING] = settings, control
    return chosen


def worths_of(
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    width: int | None,
    folder: Path,
    numbers: Iterable[int] = (DECIDING,),
    processes: int = 1,
    scheduler: str | None = None,
    **options: Any,
) -> pd.DataFrame:
    """Return the table of `worth_of` for the `choices_of` sources; what is in the folder is kept.

    width: pixels, of masks from label maps. processes, scheduler: see `workers.open_pool`.
    options: of `choices_of`. A sequence without a result is left out with a warning. Raises
    InputError if none has one.
    """
    sources, numbers = list(sources), list(numbers)
    digest = cache(provenance.digest_of_files)
    own = {source.name: source.folder for source in sources if source.kind == "keypoints"}
    calls: list[tuple] = []
    for sequence in sequences:
        chosen = choices_of(sequence, sources, width, numbers, **options)
        records = {
            f"{name} {number}": record_of(*chosen[name, number], digest) for name, number in chosen
        }
        stage = provenance.stage(
            folder / sequence.name,
            sequence=sequence.digest(),
            choices=records,
            own={name: digest((file,)) for name, file in own.items()},
            code=digest_of_code(_measure_one, *reader_of(sequence), without=TABLES),
            **provenance.versions("opencv", "numpy", "numba"),
        )
        calls.append((stage / "worth.csv", sequence, chosen, own))
    missing = [call for call in calls if not call[0].is_file()]
    missing.sort(key=lambda call: -len(call[1]))  # so that no process waits long for the last one
    # the first step of a sequence compiles, so it says nothing about the time of the others
    steps = [min(len(sequence), MAX_STEPS) for _, sequence, *_ in missing]
    reasons = []
    with (
        open_pool(processes, scheduler) as pool,
        progress(None, "worth of keypoints", total=sum(steps), unit="step") as bar,
    ):
        for count, reason in zip(steps, pool.run(_measure_one, missing), strict=True):
            if reason:
                reasons.append(reason)
            bar.update(count)
    tables = [pd.read_csv(file, dtype={"sequence": str}) for file, *_ in calls if file.is_file()]
    if not tables:
        raise InputError(reasons[0])
    for reason in reasons:
        program.log.warning(f"{reason}; it has no worth of keypoints")
    return pd.concat(tables, ignore_index=True)


def _measure_one(file: Path, sequence: Sequence, chosen: Choices, own: Mapping[str, Path]) -> str:
    """Write the table of `worth_of`; return the reason if there is none."""
    try:
        table = worth_of(sequence, chosen, {name: own_calls(path) for name, path in own.items()})
    except InputError as error:
        return str(error)
    except Exception as error:  # of own keypoints
        return f"sequence {sequence.name}: {cause(error)}"
    provenance.write_table(file, table)
    return ""


# Over several streets


def typical_worths(table: pd.DataFrame) -> pd.DataFrame:
    """Return the typical worth of each choice and number over the sequences, and its verdict.

    table: of `worth_of`, of several sequences. One row a choice and number: keypoints, n
    (sequences), verdict; for each motion and split, such as rotation_fields: the typical worth, its
    interval (_low, _high), and the number of sequences with a worth below 1 (_below).
    verdict_of_fit: that of the second measure, which decides nothing.
    """
    rows = []
    for (choice, number), chosen in table.groupby(["choice", "number"], sort=False):
        row = {"choice": choice, "number": number, "keypoints": chosen["keypoints"].mean()}
        worths: dict[str, pd.Series] = {}
        for motion in MOTIONS:
            for split, of_split in chosen.groupby("split", sort=False):
                worths[f"{motion}_{split}"] = np.log(of_split[motion])
        of_fit = {name: worths[name] for name in worths if name.endswith(ONE_FIT)}
        of_halves = {name: worths[name] for name in worths if name not in of_fit}
        row |= {"n": chosen["sequence"].nunique(), "verdict": _verdict(of_halves)}
        if of_fit:
            row["verdict_of_fit"] = _verdict(of_fit)
        for name, logarithms in worths.items():
            numbers = np.exp(ratios.typical_interval(logarithms))
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), numbers, strict=True))
            row[f"{name}_below"] = int((logarithms < 0).sum())
        rows.append(row)
    return pd.DataFrame(rows)


def over(table: pd.DataFrame, choice: str, other: str) -> pd.DataFrame:
    """Return the worths of one choice divided by those of another, as rows of the same table."""
    keys, names = ["sequence", "number", "split"], list(MOTIONS)
    first, second = (table[table["choice"] == name].set_index(keys) for name in (choice, other))
    divided = (first[names] / second[names]).dropna()
    rows = first.loc[divided.index].assign(choice=f"{choice}, over {other}", **divided)
    return rows.reset_index()[list(table)]


def _verdict(worths: Mapping[str, pd.Series]) -> str:
    """Return the verdict on the logarithms of the worths of both motions and splits, by name."""
    fewest = min(map(len, worths.values()))
    intervals = [ratios.typical_interval(each)[1:] for each in worths.values()]
    sides = [ratios.side_of_one(*np.exp(ends)) for ends in intervals]
    narrow = [
        (name.partition("_")[0], *ratios.narrow_interval(np.exp(each)))
        for name, each in worths.items()
    ]
    return verdict(verdicts.WORTH, fewest, sides, narrow)
