"""The one table of comparisons, made from a table of runs.

**Runs** (`runner.run_all`) have one row a run: sequence, run, source, method, dilation_width,
estimator, repetition, frames, mean_keypoints, flagged, and one column for each of METRIC_TITLES.

**Comparisons** (`comparisons_of`) have one row for each method, reference, metric and estimator:
the ratio of the method's error to the reference's with its interval (`ratios`), a verdict
(`verdicts.verdict`), on how many sequences each fails, and the ratios of the sequences. The rows
that answer the main question are those that `decide`.

The functions below it select parts of a table of runs.
"""

from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import methods, ratios
from keypoint_study.jobs import CONTROL_WIDTH, ESTIMATOR_TITLES
from keypoint_study.methods import MASK_CONTROLS, METHODS
from keypoint_study.path_errors import ERRORS
from keypoint_study.verdicts import verdict

# {name: title} of the methods and errors that are compared. The judging metrics decide.
METHOD_TITLES = {
    name: method.title
    for name, method in METHODS.items()
    if method.group in (methods.BROUGHT, methods.LABEL_MAPS, methods.CONTROL)
}
SEGMENTATION_FREE_CONTROLS = methods.of_group(methods.CONTROL)
BROUGHT = ("masked", "keypoints")  # methods of what a user brings; the others are controls
METRIC_TITLES = {name: error.title for name, error in ERRORS.items()}
JUDGING_METRICS = {name: error.title for name, error in ERRORS.items() if error.decides}

# of `comparisons_of`
COLUMNS = (
    "source",
    "method",
    "dilation_width",
    "keypoints",
    "reference_source",
    "reference",
    "metric",
    "estimator",
    "label",
    "tested",
    "shown",
    "decides",
    "ratio",
    "low",
    "high",
    "mean",
    "mean_low",
    "mean_high",
    "n",
    "above",
    "far_off",
    "verdict",
    "failed",
    "reference_failed",
    "more_failures",
    "fewer_failures",
    "failures_verdict",
    "ratios",
)

USUAL_JUDGE = "refined"  # the estimator that decides, since shuffling changes it least


def comparisons_of(runs: pd.DataFrame) -> pd.DataFrame:
    """Compare every method with all keypoints, and masks with controls and other sources' masks.

    Masks are compared with every control. Returns a table with the columns source, method,
    dilation_width (pixels), keypoints (mean number); reference_source, reference (the method
    compared with); metric, estimator; label (see `labels`); tested (whether the width is the
    `tested_width`); shown (whether it is that, or the source has no masks of that width); decides
    (whether the row is of the tested width, a judging metric and the `judging_estimator`); those of
    `ratios.typical_ratio`; far_off (see `ratios.far_off`); verdict; those of `failures`; and
    ratios, {sequence: its ratio}.
    Masks help if both rows that decide are LOWER than with all keypoints. The segmentation helps if
    they are also LOWER than with each of SEGMENTATION_FREE_CONTROLS.
    An error that no sequence has with both methods has no row.
    """
    runs = runs.assign(label=labels(runs))
    judging = judging_estimator(runs)
    metrics = [name for name in METRIC_TITLES if name in runs and runs[name].notna().any()]
    rows = []
    for estimator in ESTIMATOR_TITLES:
        variants = _variants(runs[runs["estimator"] == estimator], metrics)
        for (variant, errors), (reference, reference_errors) in product(variants, variants):
            if not _is_compared(variant, reference):
                continue
            of_pair = {
                **variant,
                "reference_source": reference["source"],
                "reference": reference["method"],
                "estimator": estimator,
                **failures(errors["failed"], reference_errors["failed"]),
            }
            may_decide = variant["tested"] and estimator == judging
            for metric in metrics:
                by_sequence = np.exp((errors[metric] - reference_errors[metric]).dropna())
                if not by_sequence.empty:
                    decides = may_decide and metric in JUDGING_METRICS
                    of_metric = {"metric": metric, "decides": decides}
                    rows.append(of_pair | of_metric | _numbers(by_sequence))
    table = pd.DataFrame(rows, columns=COLUMNS)
    masked = table[table["tested"].astype(bool) & (table["method"] == "masked")]
    table["shown"] = table["tested"] | ~table["source"].isin(masked["source"])
    return table


def _numbers(by_sequence: pd.Series) -> dict[str, Any]:
    """Return the columns of `comparisons_of` that follow from the ratios of the sequences."""
    typical = ratios.typical_ratio(by_sequence)
    side = ratios.side_of_one(typical["low"], typical["high"])
    return {
        **typical,
        "far_off": ratios.far_off(by_sequence),
        "verdict": verdict(typical["n"], [side]),
        "ratios": dict(by_sequence),
    }


def failures(failed: pd.Series, reference: pd.Series) -> dict[str, Any]:
    """Compare how often runs fail. failed, reference: of each run, by sequence (index).

    Returns {failed, reference_failed (`ratios.count_failing`); more_failures, fewer_failures
    (sequences on which a larger or a smaller share of runs failed than with the reference);
    failures_verdict}.
    """
    shares, reference_shares = (runs.groupby(level=0).mean() for runs in (failed, reference))
    differences = (shares - reference_shares).dropna()
    more, fewer = int((differences > 0).sum()), int((differences < 0).sum())
    side = ratios.side_of_counts(more, fewer)
    return {
        "failed": ratios.count_failing(failed),
        "reference_failed": ratios.count_failing(reference),
        "more_failures": more,
        "fewer_failures": fewer,
        "failures_verdict": verdict(len(differences), [side]),
    }


def verdict_of(rows: pd.DataFrame) -> str:
    """Return the verdict of several rows of `comparisons_of` together, such as both that decide."""
    sides = [ratios.side_of_one(low, high) for low, high in zip(rows["low"], rows["high"])]
    fewest = rows["n"].min() if len(rows) else 0
    return verdict(fewest, sides)


def _variants(
    runs: pd.DataFrame, metrics: list[str]
) -> list[tuple[dict[str, Any], dict[str, pd.Series]]]:
    """Split the runs by method, source and width.

    Returns for each part its columns of `comparisons_of`, and by metric the mean logarithms of its
    errors, which are then found only once; under "failed", whether each run has failed.
    """
    variants = []
    for method in METHOD_TITLES:
        by_width = runs[runs["method"] == method].groupby(
            ["source", "dilation_width"], dropna=False, sort=False
        )
        for (source, width), rows in by_width:
            tested_at = tested_width(of_source(runs, source))
            tested = pd.isna(width) or tested_at in (None, width)
            columns = {
                "source": source,
                "method": method,
                "dilation_width": width,
                "keypoints": rows.groupby("sequence")["mean_keypoints"].mean().mean(),
                "label": rows["label"].iloc[0],
                "tested": bool(tested),
            }
            errors = {metric: ratios.mean_logarithms(rows, metric) for metric in metrics}
            errors["failed"] = ratios.has_failed(rows.set_index("sequence"))
            variants.append((columns, errors))
    return variants


def _is_compared(variant: dict[str, Any], reference: dict[str, Any]) -> bool:
    """Return whether `comparisons_of` compares a variant with a reference, which may be itself."""
    if reference["method"] == "baseline":
        return True
    if variant is reference or variant["method"] not in ("masked", "keypoints"):
        return False
    if not (variant["tested"] and reference["tested"]):
        return False
    if variant["method"] == reference["method"] == "masked":
        return True
    return variant["source"] == reference["source"]


def judging_estimator(runs: pd.DataFrame) -> str:
    """Return the estimator that decides.

    It is the USUAL_JUDGE if it was run, and otherwise the first that was.
    """
    estimators = list(runs["estimator"])
    return USUAL_JUDGE if USUAL_JUDGE in estimators else estimators[0]


def labels(runs: pd.DataFrame) -> pd.Series:
    """Label each run with its method and the width of its masks.

    If there are several sources, the label begins with the run's source. Own keypoints are labelled
    with the name of their source.
    """
    width = runs["dilation_width"].where(runs["method"] == "masked")
    width = width.map(", width {:g}".format, na_action="ignore").astype(object).fillna("")
    label = runs["method"].map(METHOD_TITLES) + width
    if len(sources(runs)) > 1:
        label = (runs["source"] + ": " + label).str.removeprefix(": ")  # all keypoints have none
    return label.mask(runs["method"] == "keypoints", runs["source"])


# Parts of a table of runs


def of_method(runs: pd.DataFrame, method: str, estimator: str | None = None) -> pd.DataFrame:
    """Return the runs of one method under one estimator.

    estimator: by default the thesis's estimator if it was run, as for the tables of the thesis.
    """
    if estimator is None:
        were_run = set(runs["estimator"])
        estimator = next((name for name in ESTIMATOR_TITLES if name in were_run), "thesis")
    return runs[(runs["method"] == method) & (runs["estimator"] == estimator)]


def of_source(runs: pd.DataFrame, source: str) -> pd.DataFrame:
    """Return the runs of one source of masks.

    The runs with all keypoints are among them, since they belong to every source.
    """
    return runs[runs["source"].isin([source, ""])]


def sources(runs: pd.DataFrame) -> list[str]:
    """Return the names of the sources, in the order of their runs."""
    return [name for name in runs["source"].unique() if name]


def tested_width(runs: pd.DataFrame) -> int | None:
    """Return the dilation width (pixels) at which masks are tested.

    It is that of the controls, or else the only width of masks. Returns CONTROL_WIDTH if the width
    is not unique, and None for ready-made masks.
    """
    masked = runs.loc[runs["method"] == "masked", "dilation_width"]
    if len(masked) and masked.isna().all():
        return None
    controls = runs.loc[runs["method"].isin(MASK_CONTROLS), "dilation_width"].dropna()
    widths = masked.unique()
    if len(controls):
        widths = controls.unique()
    if len(widths) != 1:
        return CONTROL_WIDTH
    return int(widths[0])


def keypoints_left(runs: pd.DataFrame, source: str) -> pd.Series:
    """Return how many keypoints a source's masks leave, or its code finds, by sequence.

    It is the mean of its runs; of masks, those of the `tested_width`.
    """
    runs = of_source(runs, source)
    brought = runs[runs["method"].isin(["masked", "keypoints"])]
    widths = brought["dilation_width"]
    rows = brought[widths.isna() | (widths == tested_width(runs))]
    return rows.groupby("sequence")["mean_keypoints"].mean()
