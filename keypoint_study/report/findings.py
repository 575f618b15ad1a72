"""The findings of a run, a study or the evidence on real frames: sentences and tables.

Each table is a selection from `compare.comparisons`. The words stand in findings.md.j2.
"""

import pandas as pd

from keypoint_study import best_width, compare
from keypoint_study.jobs import CONTROL_WIDTH, ESTIMATORS
from keypoint_study.report import comparison, style, texts

OUTCOMES = {
    compare.LOWER: "lower errors than with all keypoints",
    compare.HIGHER: "higher errors than with all keypoints",
    compare.NO_CLEAR_DIFFERENCE: "no clear difference from all keypoints",
    compare.TOO_FEW: "too few sequences to tell",
}
METHODS = (*comparison.BROUGHT, "corrected")
SHOWN = (*compare.JUDGING_METRICS, "rmse")  # the last one as the thesis measures it
NOT_RUN = " The {usual}, which usually decides, was not run. So the {judge} decides, the first that was run."
WORLD = " The embedded world has rendered streets; its results are no evidence about KITTI."


def text(runs: pd.DataFrame, table: pd.DataFrame, data: str, embedded: bool, more: str = "") -> str:
    """Return the findings of a run, a study or the evidence as Markdown.

    table: `compare.comparisons` of the runs. data: one line with the origin of the data.
    embedded: whether the frames are those of the embedded world, which is no evidence about KITTI.
    more: Markdown below the first table.
    """
    judge = compare.judging_estimator(runs)
    not_run = NOT_RUN.format(usual=ESTIMATORS[compare.USUAL_JUDGE], judge=ESTIMATORS[judge])
    rows = table[table["tested"] & (table["reference"] == "baseline")]
    rows = rows[rows["method"].isin(METHODS) & rows["metric"].isin(SHOWN)]
    rows = rows.sort_values("decides", ascending=False, kind="stable")
    judging = rows[rows["decides"] & (rows["method"] != "corrected")]
    masked = table[table["decides"] & (table["method"] == "masked")]
    controls = masked[masked["reference"].isin(compare.SEGMENTATION_FREE_CONTROLS)]
    controls = controls[controls["reference_source"] == controls["source"]]
    verdicts = controls.groupby(["source", "reference"], sort=False)["verdict"].agg(compare.overall)
    sources = []
    for (source, label), pair in judging.groupby(["source", "label"], sort=False):
        outcome = OUTCOMES[compare.overall(pair["verdict"])]
        sources.append({"title": label, "outcome": outcome, "of_controls": ""})
        if source in verdicts:
            beaten = (verdicts[source] == compare.LOWER).sum()
            sources[-1]["of_controls"] = (
                f" Errors are lower than with {beaten} of {len(verdicts[source])} controls without "
                "segmentation."
            )
    return texts.render(
        "findings.md.j2",
        sources=sources,
        here="in the embedded world" if embedded else "here",
        world=WORLD if embedded else "",
        not_run="" if judge == compare.USUAL_JUDGE else not_run,
        more=more,
        data=data,
        frames=_frames(runs),
        level=compare.LEVEL,
        fewest=compare.MIN_SEQUENCES,
        far=compare.FAR_OFF,
        thesis_width=CONTROL_WIDTH,
        ratios=style.markdown(_ratios(rows)),
        spread=style.markdown(_spread(runs)),
        failures=style.markdown(_failures(rows)),
        controls=style.markdown(verdicts.rename(compare.METHODS).unstack("source").reset_index()),
        pairs=style.markdown(_pairs(masked[masked["reference"] == "masked"])),
        stability=style.markdown(_stability(runs)),
    )


def _ratios(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios to all keypoints, one row for each source, estimator and error."""
    sequences = compare.sequences_of(rows)
    lines = []
    for _, row in rows.iterrows():
        ratios = row[sequences].drop(row["far_off"]).dropna()
        without = ""
        if row["far_off"]:
            left_out = ", ".join(row["far_off"])
            without = f"{texts.ratio(compare.typical_ratio(ratios))} without {left_out}"
        lines.append(
            {
                "keypoints": row["label"],
                "estimator": ESTIMATORS[row["estimator"]],
                "error": compare.METRICS[row["metric"]],
                "ratio": texts.ratio(row),
                "without what is far off": without,
                "above 1": f"{row['above']} of {row['n']}",
                "verdict": row["verdict"],
                "decides": "yes" if row["decides"] else "",
            }
        )
    return pd.DataFrame(lines)


def _failures(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the failed runs of each source and of all keypoints, one row for each estimator."""
    counted = rows.drop_duplicates(["label", "estimator"])
    return pd.DataFrame(
        {
            "keypoints": counted["label"],
            "estimator": counted["estimator"].map(ESTIMATORS),
            "failed runs": counted["failed"],
            "with all keypoints": counted["reference_failed"],
            "sequences with more": counted["more_failures"],
            "with fewer": counted["fewer_failures"],
            "verdict": counted["failures_verdict"],
        }
    )


def _pairs(rows: pd.DataFrame) -> pd.DataFrame:
    """Return the ratios of masks of one source to masks of another, each pair once."""
    rows = rows[rows["source"] < rows["reference_source"]]
    return pd.DataFrame(
        {
            "masks": rows["source"],
            "divided by": rows["reference_source"],
            "error": rows["metric"].map(compare.METRICS),
            "ratio": [texts.ratio(row) for _, row in rows.iterrows()],
            "verdict": rows["verdict"],
        }
    )


def _spread(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how much shuffling changes the RMSE with all keypoints, one row an estimator."""
    factors = compare.shuffle_spread(runs).groupby("estimator")["factor"]
    spread = factors.agg(["median", "max"]).reindex(list(ESTIMATORS)).dropna().round(3)
    return spread.rename(index=ESTIMATORS, columns={"max": "highest"}).reset_index()


def _stability(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how often a best width wins again, one row for each source with repeated widths."""
    lines = []
    for source in compare.sources(runs) or [""]:
        of_source = compare.of_source(runs, source)
        masked = compare.of_method(of_source, "masked")
        stability = best_width.stability(masked, compare.of_method(of_source, "baseline"))
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
