"""The findings of a run, a study or the evidence on real frames, in words.

They share one template (findings.md.j2). Its conditions depend only on what was run and on the
verdicts.
"""

from typing import Any

import pandas as pd

from thesis_repro.report import texts
from thesis_repro.study import best_width, compare
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS
from thesis_repro.study.sources import UNMASKED

# what the template of the findings says of every comparison, whatever was run
OF_COMPARISONS = {
    "estimators": ESTIMATORS,
    "methods": compare.METHODS,
    "metrics": compare.METRICS,
    "deciding_metrics": list(compare.JUDGING_METRICS),
    "too_few": compare.TOO_FEW,
    "fewest": compare.MIN_SEQUENCES,
    "power": compare.POWER,
    "level": compare.LEVEL,
    "far": compare.FAR_OFF,
    "thesis_width": CONTROL_WIDTH,
}


def text(
    runs: pd.DataFrame,
    table: pd.DataFrame,
    data: str,
    embedded: bool,
    label_maps: list[dict[str, Any]] | tuple[()] = (),
    trainings: list[dict[str, Any]] | tuple[()] = (),
    procedure: list[dict[str, Any]] | tuple[()] = (),
) -> str:
    """Return the findings of a run, a study or the evidence as Markdown.

    table: `compare.comparisons` of the runs. data: one line with the origin of the data.
    embedded: whether the frames are those of the embedded world, which is no evidence about KITTI.
    The reproduction of the thesis adds: label_maps, the quality of the label maps, one dict a
    domain; trainings, what other trainings of the network give, one dict an estimator; procedure,
    what the thesis's own procedure gives, one dict a metric (see the modules in notebooks/thesis).
    """
    baseline = runs[runs["method"] == "baseline"]
    with_masks = runs.loc[runs["method"] == "masked", "source"].unique()
    factors = compare.shuffle_spread(runs).groupby("estimator")["factor"]
    spread = factors.agg(["median", "max"]).reindex(list(ESTIMATORS)).dropna()
    measured = set(table["metric"])
    deciding = [label for name, label in compare.JUDGING_METRICS.items() if name in measured]
    both_masked = (table["method"] == "masked") & (table["reference"] == "masked")
    once = table["source"] < table["reference_source"]  # each pair of sources
    unmasked = table["method"].isin(UNMASKED)
    return texts.render(
        "findings.md.j2",
        **OF_COMPARISONS,
        data=data,
        embedded=embedded,
        label_maps=label_maps,
        trainings=trainings,
        frames=baseline.groupby("sequence")["frames"].first().to_dict(),
        repetitions=baseline["repetition"].nunique(),
        spread=spread.T.to_dict(),
        deciding=deciding,
        estimators_run=set(table["estimator"]),
        sources=[_source_values(runs, table, source) for source in with_masks],
        procedure=procedure,
        others=table[(both_masked & once | unmasked) & _judging(table)].to_dict("records"),
    )


def _judging(table: pd.DataFrame) -> pd.Series:
    """Return for each row of `compare.comparisons` whether it may decide, bool."""
    metric = table["metric"].isin(compare.JUDGING_METRICS)
    return metric & (table["estimator"] == compare.judging_estimator(table))


def _without_far_off(row: pd.Series) -> dict[str, Any]:
    """Return a row of `compare.comparisons` over the sequences that are not far off.

    It has the names of those left out, too.
    """
    ratios = row.drop([*compare.COLUMNS, *row["far_off"]]).dropna()
    typical = compare.typical_ratio(ratios)
    return {"metric": row["metric"], "left_out": row["far_off"], "far_off": [], **typical}


def _source_values(runs: pd.DataFrame, table: pd.DataFrame, source: str) -> dict[str, Any]:
    """Return the values of one source of masks for the template."""
    runs = compare.of_source(runs, source)
    masked = compare.of_method(runs, "masked")
    stability = best_width.stability(masked, compare.of_method(runs, "baseline"))
    judged = compare.primary_comparison(table, source)
    over_all = (table["source"] == source) & (table["reference"] == "baseline") & table["tested"]
    of_masks = table[over_all & (table["method"] == "masked")]
    of_corrected = table[over_all & (table["method"] == "corrected") & _judging(table)]
    controls = compare.against(table, compare.SEGMENTATION_FREE_CONTROLS, source)
    controls = controls[controls["reference_source"] == source]
    verdicts = controls.groupby("reference", sort=False)["verdict"].agg(compare.overall)
    return {
        "name": source,
        "judged": judged.to_dict("records"),
        "without": [_without_far_off(row) for _, row in judged.iterrows() if row["far_off"]],
        "verdict": compare.overall(judged["verdict"]),
        "width": compare.tested_width(runs),
        "masked": of_masks.to_dict("records"),
        "failures": of_masks.drop_duplicates("estimator").to_dict("records"),
        "corrected": of_corrected.to_dict("records"),
        "controls": verdicts.to_dict(),
        "widths": masked["dilation_width"].nunique(),
        "same_best": stability["same_best"].mean(),
        "repeated": stability["same_best"].count(),
    }
