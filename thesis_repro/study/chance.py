"""What chance alone would report: the thesis's own procedure where masks do nothing (Section 4.2, Tables 4.2 and 4.3).

The thesis runs all keypoints once, masks of 15 widths once each, takes the best width of each sequence and averages the
percentages. If masks did nothing, each of the 16 runs would be the same run in another order of the correspondences.
How far apart such runs lie is measured; the rest is drawing.
"""

import numpy as np
import pandas as pd

from thesis_repro.odometry.metrics import percent_change

SEQUENCES, WIDTHS = 11, 15  # of the thesis
DRAWS = 4000
LEVEL = 95  # percent


def deviations(errors: pd.DataFrame) -> np.ndarray:
    """How far the logarithms of one sequence's errors lie from their mean, over orders of the correspondences.

    errors: columns sequence and rmse, several rows a sequence. All sequences together, widened for the mean that each
    of them has been taken from.
    """
    found = []
    for _, values in errors.groupby("sequence")["rmse"]:
        logs = np.log(values.to_numpy())
        if len(logs) > 1:
            found.append((logs - logs.mean()) * np.sqrt(len(logs) / (len(logs) - 1)))
    return np.concatenate(found) if found else np.empty(0)


def nothing(errors: pd.DataFrame, sequences: int = SEQUENCES, widths: int = WIDTHS, draws: int = DRAWS,
            seed: int = 0) -> pd.DataFrame:
    """What the procedure reports where masks do nothing: rows mean, median and sum over sequences of the change (%).

    errors: of all keypoints in several orders, see `deviations`. Columns expected, low, high: the mean and the middle
    LEVEL percent of `draws` simulated studies. Deviations are drawn from the measured ones with replacement, so the
    best of 15 is never better than the best order that was measured.
    """
    changes = _changes(errors, sequences, widths, draws, seed)
    rows = {"mean": changes.mean(axis=1), "median": np.median(changes, axis=1), "sum": changes.sum(axis=1)}
    tail = (100 - LEVEL) / 2
    return pd.DataFrame({name: {"expected": values.mean(), "low": np.percentile(values, tail),
                                "high": np.percentile(values, 100 - tail)} for name, values in rows.items()}).T


def share_as_low(errors: pd.DataFrame, mean: float, median: float, **options: int) -> tuple[float, float]:
    """In what share of such studies the mean, and the median, is as low as a reported one (0 to 1)."""
    changes = _changes(errors, **{"sequences": SEQUENCES, "widths": WIDTHS, "draws": DRAWS, "seed": 0} | options)
    return float((changes.mean(axis=1) <= mean).mean()), float((np.median(changes, axis=1) <= median).mean())


def _changes(errors: pd.DataFrame, sequences: int, widths: int, draws: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed).choice(deviations(errors), (draws, sequences, widths + 1))
    return percent_change(np.exp(drawn[..., 1:].min(axis=-1)), np.exp(drawn[..., 0]))


def by_length(prefixes: pd.DataFrame, **options: int) -> pd.DataFrame:
    """`nothing` for ever longer stretches from the start of each sequence: one row a stretch.

    prefixes: the second table of `effects.measure`. Columns frames and metres (means over sequences), spread (the
    factor that one standard deviation between orders makes), and mean, median with their low and high.
    """
    parts = prefixes.groupby("sequence")["frames"].rank(method="dense").astype(int)
    rows = []
    for _, stretch in prefixes.groupby(parts):
        found = nothing(stretch, **options)
        rows.append({"frames": stretch["frames"].mean(), "metres": stretch["metres"].mean(),
                     "spread": float(np.exp(np.sqrt((deviations(stretch) ** 2).mean()))),
                     **{f"{name}{end}": found.loc[name, column] for name in ("mean", "median")
                        for end, column in (("", "expected"), (", low", "low"), (", high", "high"))}})
    return pd.DataFrame(rows)
