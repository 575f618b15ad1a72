"""The findings of a run, a study or the evidence on real frames: sentences and one table.

The words stand in findings.md.j2, those for outcomes in `verdicts`.
"""

from typing import Any

import pandas as pd

from keypoint_study import best_width, comparisons, ratios, verdicts
from keypoint_study.comparisons import BROUGHT
from keypoint_study.jobs import CONTROL_WIDTH, ESTIMATOR_TITLES
from keypoint_study.report import comparison, style, texts

OUTCOMES = {
    verdicts.LOWER: "lower errors than with all keypoints",
    verdicts.HIGHER: "higher errors than with all keypoints",
    verdicts.NO_CLEAR_DIFFERENCE: "no clear difference from all keypoints",
    verdicts.TOO_FEW: "too few sequences to tell",
}


def findings_of(
    runs: pd.DataFrame, table: pd.DataFrame, data: str, embedded: bool, more: str = ""
) -> str:
    """Return the findings of a run, a study or the evidence as Markdown.

    table: `comparisons_of` the runs. data: one line with the origin of the data. embedded: whether
    the frames are those of the embedded world, which is no evidence about KITTI. more: Markdown
    below the table.
    """
    judge = comparisons.judging_estimator(runs)
    rows = _told(table, judge)
    deciding = table[table["decides"] & table["method"].isin(BROUGHT)]
    of_all = deciding[deciding["reference"] == "baseline"]
    return texts.render(
        "findings.md.j2",
        results=[
            _result(label, pair, deciding) for label, pair in of_all.groupby("label", sort=False)
        ],
        embedded=embedded,
        judge=ESTIMATOR_TITLES[judge],
        usual=ESTIMATOR_TITLES[comparisons.USUAL_JUDGE],
        more=more,
        data=data,
        frames=_frames(runs),
        level=verdicts.LEVEL,
        fewest=verdicts.MIN_SEQUENCES,
        far=ratios.FAR_OFF,
        thesis_width=CONTROL_WIDTH,
        ratios=style.markdown(comparison.table_of_ratios(rows)),
        spread=style.markdown(_shuffles(runs)),
        stability=style.markdown(_stability(runs)),
    )


def _told(table: pd.DataFrame, judge: str) -> pd.DataFrame:
    """Return the rows of the findings' table.

    What a user brings and the corrected mask are compared with all keypoints, under the estimator
    that decides first; with it, masks are compared with the controls and with other masks.
    """
    is_told = table["tested"] & table["method"].isin([*BROUGHT, "corrected"])
    is_over_all = table["reference"] == "baseline"
    is_over_control = table["reference"].isin(comparisons.SEGMENTATION_FREE_CONTROLS)
    is_over_control &= table["source"] == table["reference_source"]
    is_pair = (table["reference"] == "masked") & (table["source"] < table["reference_source"])
    decides = table["estimator"] == judge
    rows = table[is_told & (is_over_all | decides & (is_over_control | is_pair))]
    order = [*dict.fromkeys([judge, *ESTIMATOR_TITLES])]
    return comparison.all_of(rows).sort_values(
        "estimator", key=lambda names: names.map(order.index), kind="stable"
    )


def _result(label: str, pair: pd.DataFrame, deciding: pd.DataFrame) -> dict[str, Any]:
    """Return what the findings say of one label: both rows that decide, against all keypoints."""
    over_controls = deciding[
        (deciding["label"] == label)
        & deciding["reference"].isin(comparisons.SEGMENTATION_FREE_CONTROLS)
        & (deciding["reference_source"] == pair["source"].iloc[0])
    ]
    of_controls = [comparisons.verdict_of(rows) for _, rows in over_controls.groupby("reference")]
    without = []
    for _, row in pair[pair["far_off"].map(len) > 0].iterrows():
        left = ratios.typical_ratio(pd.Series(row["ratios"]).drop(row["far_off"]))
        error = comparisons.METRIC_TITLES[row["metric"]]
        without.append(f"without {', '.join(row['far_off'])}, {error} is {texts.short(left)}")
    return {
        "title": label,
        "outcome": OUTCOMES[comparisons.verdict_of(pair)],
        "controls": len(of_controls),
        "beaten": of_controls.count(verdicts.LOWER),
        "too_few": verdicts.TOO_FEW in of_controls,
        "without": "; ".join(without),
    }


def _shuffles(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how much shuffling changes the RMSE with all keypoints, one row an estimator."""
    factors = ratios.range_of_shuffles(runs).groupby("estimator")["factor"]
    spread = factors.agg(["median", "max"]).reindex(list(ESTIMATOR_TITLES)).dropna().round(3)
    return spread.rename(index=ESTIMATOR_TITLES, columns={"max": "highest"}).reset_index()


def _stability(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how often a best width wins again, one row for each source with repeated widths."""
    lines = []
    for source in comparisons.sources(runs) or [""]:
        of_source = comparisons.of_source(runs, source)
        masked = comparisons.of_method(of_source, "masked")
        stability = best_width.stability(masked, comparisons.of_method(of_source, "baseline"))
        widths, same = masked["dilation_width"].nunique(), stability["same_best"]
        if same.count():
            line = {"source": source, "sequences": same.count(), "widths": widths}
            lines.append(
                line | {"wins again": same.mean().round(), "by chance": round(100 / widths)}
            )
    return pd.DataFrame(lines)


def _frames(runs: pd.DataFrame) -> str:
    """Return one line with the sequences, their frames and the number of repetitions."""
    baseline = runs[runs["method"] == "baseline"]
    frames = baseline.groupby("sequence")["frames"].first()
    counts = [f"{texts.in_markdown(name)} ({count} frames)" for name, count in frames.items()]
    return (
        f"Sequences: {', '.join(counts)}. Repetitions of every run that decides: "
        f"{baseline['repetition'].nunique()}."
    )
