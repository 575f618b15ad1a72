"""Texts made from templates (templates/*.j2).

Their conditions depend only on what was run and on the verdicts. A run, a study with the user's
masks and the evidence on real frames share one template for their findings.
"""

import os
import re
import shlex
from math import ceil, log10
from pathlib import Path
from typing import Any
from urllib.parse import quote

import mistune
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from thesis_repro.errors import one_line
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS

DIGITS = 2  # of a ratio that is not close to 1
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=lambda name: ".html" in (name or ""),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """Return the text of a template in the folder templates.

    Repeated empty lines in Markdown become one.
    """
    text = TEMPLATES.get_template(template).render(values).strip() + "\n"
    if ".md" in template:
        text = re.sub(r"\n{3,}", "\n\n", text)
    return text


def number(value: float) -> str:
    """Return a ratio as text with two digits, or with more if it would look like 1."""
    digits = DIGITS
    distance = abs(value - 1)
    if 0 < distance < 0.5 * 10**-DIGITS:
        digits = min(6, ceil(-log10(distance)) + 1)
    return f"{value:.{digits}f}"


def two_digits(value: float) -> str:
    """Return a number as text with two digits that are not zero, such as 0.0078; "" if missing."""
    if pd.isna(value):
        return ""
    return f"{float(f'{value:.2g}'):g}"


def ratio(row: dict[str, Any] | pd.Series) -> str:
    """Return "1.09 (95 % CI 0.98-1.32)" for a row with ratio, low and high.

    Without an interval (low is missing) it is only the ratio.
    """
    mean = number(row["ratio"])
    if pd.isna(row["low"]):
        return mean
    low, high = number(row["low"]), number(row["high"])
    return f"{mean} ({compare.LEVEL} % CI {low}-{high})"


def ratio_and_far_off(row: dict[str, Any] | pd.Series) -> str:
    """Return `ratio` and the sequences far from the others.

    Such as "3.85 (95 % CI 0.71-80.41), sequence 01 alone 95.20".
    """
    text = ratio(row)
    for name in row["far_off"]:
        text += f", sequence {in_markdown(name)} alone {number(row[name])}"
    return text


def in_markdown(text: object) -> str:
    """Return a name as one line that Markdown shows as it is.

    It then makes no link, picture, HTML tag, emphasis or cell of a table.
    """
    special = r"[\\`*<>|&~]|\](?=[(\[])|(?<![^\W_])_|_(?![^\W_])"
    return re.sub(special, r"\\\g<0>", one_line(text))


def in_url(name: str) -> str:
    """Return the name of a file for a link, whatever its bytes."""
    return quote(os.fsencode(name))


TEMPLATES.filters["in_markdown"] = in_markdown
TEMPLATES.filters["in_shell"] = shlex.quote
TEMPLATES.filters["one_line"] = one_line
TEMPLATES.filters["urlencode"] = in_url
TEMPLATES.filters["ratio"] = ratio_and_far_off
TEMPLATES.filters["number"] = number
TEMPLATES.filters["two_digits"] = two_digits


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text: str, level: int, **attributes: Any) -> str:
        # lower than the headings of the page
        return super().heading(text, max(4, level + 1), **attributes)


def html(text: str) -> Markup:
    """Convert Markdown to HTML. HTML tags in the Markdown are shown as text."""
    convert = mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])
    return Markup(convert(text))


# what the template of the findings says of every comparison, whatever was run
OF_COMPARISONS = {
    "estimators": ESTIMATORS,
    "methods": compare.METHODS,
    "metrics": compare.METRICS,
    "deciding_metrics": list(compare.JUDGING_METRICS),
    "too_few": compare.TOO_FEW,
    "fewest": compare.MIN_SEQUENCES,
    "least": compare.MIN_FOR_INTERVAL,
    "level": compare.LEVEL,
    "far": compare.FAR_OFF,
    "thesis_width": CONTROL_WIDTH,
}


def findings(
    runs: pd.DataFrame,
    table: pd.DataFrame,
    data: str,
    embedded: bool,
    label_maps: list[dict[str, Any]] | tuple[()] = (),
    trainings: list[dict[str, Any]] | tuple[()] = (),
    shuffled: pd.DataFrame | None = None,
) -> str:
    """Return the findings of a run, a study or the evidence as Markdown.

    table: `compare.comparisons` of the runs. data: one line with the origin of the data.
    embedded: whether the frames are those of the embedded world, which is no evidence about KITTI.
    label_maps: the quality of the label maps, rows of `gap.label_map_quality`.
    trainings: what other trainings of the network give, from `trainings.summary`. shuffled: runs
    with all keypoints, to simulate the thesis's procedure if masks did nothing.
    """
    baseline = runs[runs["method"] == "baseline"]
    with_masks = set(runs.loc[runs["method"] == "masked", "source"])
    sources = [
        _source_values(runs, table, source)
        for source in compare.sources(runs) or [""]
        if source in with_masks
    ]
    measured = set(table["metric"])
    deciding = [label for name, label in compare.JUDGING_METRICS.items() if name in measured]
    return render(
        "findings.md.j2",
        **OF_COMPARISONS,
        data=data,
        embedded=embedded,
        label_maps=label_maps,
        trainings=trainings,
        frames=baseline.groupby("sequence")["frames"].first().to_dict(),
        repetitions=baseline["repetition"].nunique(),
        spread=_shuffle_spread(runs),
        deciding=deciding,
        estimators_run=set(table["estimator"]),
        sources=sources,
        procedure=[] if shuffled is None else _thesis_procedure(runs, shuffled),
        against_each_other=_sources_against_each_other(table),
    )


def _thesis_procedure(runs: pd.DataFrame, shuffled: pd.DataFrame) -> list[dict[str, Any]]:
    """Return what the thesis's literal procedure gives (Tables 4.2 and 4.3), one dict a metric.

    Changes are in percent: mean, median, improved and lost (sequences) of repetition 0; lowest and
    highest mean of a repetition; null_mean, null_low, null_high and null_improved if masks did
    nothing (`thesis_tables.changes_if_masks_did_nothing`).
    """
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    widths = masked["dilation_width"].nunique()
    # the embedded world repeats only one width, and one width is no choice
    widths_run = masked.groupby("repetition")["dilation_width"].nunique()
    repetitions = sorted(widths_run.index[widths_run == widths])
    rows = []
    for metric in ("rmse", "mae"):
        by_repetition = [
            thesis_tables.changes_of_repetition(masked, baseline, metric, repetition)
            for repetition in repetitions
        ]
        means = [changes.mean() for changes in by_repetition]
        best = thesis_tables.of_chosen_width(masked[masked["repetition"] == 0])
        studies = thesis_tables.changes_if_masks_did_nothing(shuffled, widths, metric)
        null_means = studies.mean(axis=1)
        null_low, null_high = thesis_tables.middle(null_means)
        row = {
            "name": compare.METRICS[metric],
            "widths": widths,
            "sequences": len(by_repetition[0]),
            "mean": means[0],
            "median": by_repetition[0].median(),
            "improved": thesis_tables.improved(by_repetition[0], best),
            "lost": int(best["lost"].sum()),
            "lowest": min(means),
            "highest": max(means),
            "repetitions": len(means),
            "studies": len(studies),
            "null_mean": null_means.mean(),
            "null_low": null_low,
            "null_high": null_high,
            "null_improved": (studies < 0).sum(axis=1).mean(),
        }
        rows.append(row)
    return rows


def _shuffle_spread(runs: pd.DataFrame) -> dict[str, dict[str, float]]:
    """Return {estimator: {"median", "max"}} of the factors of `compare.shuffle_spread`."""
    factors = compare.shuffle_spread(runs).groupby("estimator")["factor"]
    spread = factors.agg(["median", "max"]).reindex(list(ESTIMATORS)).dropna()
    return spread.T.to_dict()


def _sources_against_each_other(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the rows of `table` that compare masks of two sources, each pair of sources once."""
    both_masked = (table["method"] == "masked") & (table["reference"] == "masked")
    once = table["source"] < table["reference_source"]
    pairs = table[both_masked & once & _judging(table)]
    return pairs.to_dict("records")


def _judging(table: pd.DataFrame) -> pd.Series:
    """Return for each row of `compare.comparisons` whether it may decide, bool."""
    metric = table["metric"].isin(compare.JUDGING_METRICS)
    return metric & (table["estimator"] == compare.judging_estimator(table))


def _source_values(runs: pd.DataFrame, table: pd.DataFrame, source: str) -> dict[str, Any]:
    """Return the values of one source of masks for the template."""
    runs = compare.of_source(runs, source)
    masked = compare.of_method(runs, "masked")
    widths = masked["dilation_width"].nunique()
    same_best, repeated = None, 0
    if widths > 1:
        stability = thesis_tables.stability(masked, compare.of_method(runs, "baseline"))
        mean = stability["same_best"].mean()
        if not pd.isna(mean):
            same_best, repeated = float(mean), int(stability["same_best"].count())
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
        "verdict": compare.overall(judged["verdict"]),
        "width": compare.tested_width(runs),
        "masked": of_masks.to_dict("records"),
        "lost": of_masks.drop_duplicates("estimator").to_dict("records"),
        "corrected": of_corrected.to_dict("records"),
        "controls": verdicts.to_dict(),
        "widths": widths,
        "same_best": same_best,
        "repeated": repeated,
    }
