"""The worth of a keypoint beside the truth, where the motion of every step is exact.

The true variance of a keypoint is n angle^2, where angle is that between the motion of n keypoints
and the exact one: the median over steps and draws. The true worth is this variance of random
keypoints divided by that of a choice, as `worth` has it without a truth. `make worth-check`
measures both in the embedded world and writes TABLE. What factor is too much: `verdicts.TOO_FAR`.
"""

from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import ratios, worth
from keypoint_study.worth import MOTIONS, SPLIT, Choices, Tracks
from thesis_repro.data.sequence import Sequence
from thesis_repro.odometry import Motion, metrics
from thesis_repro.odometry.sharing import SharedCalls

TABLE = Path(__file__).with_name("worth_check.csv")
TRUE = "true"
OVER = ", over "  # in the name of a choice whose worth is divided by that of another one


def true_worths(sequence: Sequence, chosen: Choices, draws: int) -> pd.DataFrame:
    """Return the true worth of each choice on a sequence with exact poses.

    chosen: as for `worth.worth_of`, with numbers above 0. draws: of so many keypoints, in each step
    of 0.25 m or more. One row a choice and number: sequence, choice, number, rotation, direction.
    """
    shared, rows = SharedCalls(), []
    for index in np.flatnonzero(sequence.scales[1:] >= metrics.MIN_DIRECTED_STEP):
        step = np.linalg.inv(sequence.poses[index]) @ sequence.poses[index + 1]
        exact = Motion(step[:3, :3], step[:3, 3])
        random, of_choices = worth.tracked(sequence, int(index), chosen, shared, {})
        of_random: dict[int, pd.DataFrame] = {}
        for (name, number), tracks in of_choices.items():
            count = min(number, len(tracks.points))
            if count not in of_random:
                as_many = max(count, worth.MIN_RANDOM)
                of_random[count] = _variances(random, as_many, exact, (int(index), 1), draws)
            variances = _variances(tracks, count, exact, (int(index), 0), draws)
            both = variances.join(of_random[count].add_suffix("_random"))
            rows.append(both.assign(choice=name, number=number))
    medians = pd.concat(rows).groupby(["choice", "number"], sort=False).median()
    table = pd.DataFrame({name: medians[f"{name}_random"] / medians[name] for name in MOTIONS})
    return table.reset_index().assign(sequence=sequence.name)


def _variances(
    tracks: Tracks, count: int, exact: Motion, seed: tuple[int, ...], draws: int
) -> pd.DataFrame:
    """Return the variance of one keypoint (degrees^2) of each draw, for both MOTIONS."""
    pairs: list[tuple[Motion | None, Motion | None]] = []
    for draw in range(draws):
        random = np.random.default_rng((worth.SEED, draw, *seed))
        drawn = random.permutation(len(tracks.points))[:count]
        pairs.append((worth.refined_motion(tracks, drawn), exact))
    return pd.DataFrame(np.square(worth._angles(pairs)) * max(count, 1), columns=list(MOTIONS))


def table_of_checks(estimated: pd.DataFrame, true: pd.DataFrame) -> pd.DataFrame:
    """Return one row a choice and number: its typical worths over the sequences, and `factor_off`.

    estimated: of `worth.worth_of`; true: of `true_worths`. For each motion the columns are such as
    rotation_true, rotation_fields, rotation_points.
    """
    kinds = pd.concat([true.assign(split=TRUE), estimated[estimated["split"].isin(SPLIT)]])
    rows = []
    for (choice, number), chosen in kinds.groupby(["choice", "number"], sort=False):
        row: dict[str, Any] = {"choice": choice, "number": number}
        row["n"] = chosen["sequence"].nunique()
        for motion, kind in product(MOTIONS, (TRUE, *SPLIT)):
            logarithms = np.log(chosen.loc[chosen["split"] == kind, motion])
            row[f"{motion}_{kind}"] = np.exp(ratios.typical_interval(logarithms)[0])
        rows.append(row)
    return pd.DataFrame(rows)


@cache
def checks() -> pd.DataFrame:
    """Return TABLE, by choice and number."""
    return pd.read_csv(TABLE).set_index(["choice", "number"])


def factor_off(choice: str, number: int) -> float:
    """Return the largest factor between worth and truth, of both motions and kinds of halves.

    choice: of TABLE, perhaps behind the name of a source ("mine: masks"), or one divided by another
    ("masks, over mirrored mask"), whose factors are divided, too. NaN for what is not in TABLE.
    """
    names = [(name.rpartition(": ")[2], number) for name in choice.split(OVER)]
    if not all(name in checks().index for name in names):
        return np.nan
    first, *others = (_logarithms_off(checks().loc[name]) for name in names)
    return float(np.exp(np.abs(first - sum(others)).max()))


def _logarithms_off(row: pd.Series) -> np.ndarray:
    """Return the logarithms of worth over truth, of both motions and kinds of halves."""
    pairs = product(MOTIONS, SPLIT)
    return np.log([row[f"{motion}_{kind}"] / row[f"{motion}_{TRUE}"] for motion, kind in pairs])
