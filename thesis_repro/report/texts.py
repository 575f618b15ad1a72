"""Texts made from templates (templates/*.j2). Their conditions depend only on what was run and on
the verdicts.

A run, a study with the user's masks and the evidence on real frames share one template for their
findings.
"""

import re
from math import ceil, log10
from pathlib import Path
from typing import Any

import mistune
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import Result, metrics
from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS

DIGITS = 2  # of a ratio that is not close to 1
ERRORS = (
    "rmse_m",
    "mae_m",
    "ate_se3_m",
    "relative_translation_percent",
    "relative_rotation_deg_per_100m",
)
TEMPLATES = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    autoescape=lambda name: ".html" in (name or ""),
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)


def render(template: str, **values: Any) -> str:
    """Return the text of a template in the folder templates. Repeated empty lines in Markdown
    become one.
    """
    text = TEMPLATES.get_template(template).render(values).strip() + "\n"
    return re.sub(r"\n{3,}", "\n\n", text) if ".md" in template else text


def number(value: float) -> str:
    """Return a ratio as text with two digits, or with more if it would look like 1."""
    near = 0 < abs(value - 1) < 0.5 * 10**-DIGITS
    return f"{value:.{min(6, ceil(-log10(abs(value - 1))) + 1) if near else DIGITS}f}"


def ratio(row: dict[str, Any] | pd.Series) -> str:
    """Return "1.09 (95 % CI 0.98-1.32)" for a row with ratio, low and high, or only the ratio
    if low is missing.
    """
    if pd.isna(row["low"]):
        return number(row["ratio"])
    return (
        f"{number(row['ratio'])} ({compare.LEVEL} % CI {number(row['low'])}-{number(row['high'])})"
    )


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text: str, level: int, **attributes: Any) -> str:
        # lower than the headings of the page
        return super().heading(text, max(4, level + 1), **attributes)


def html(text: str) -> Markup:
    """Convert Markdown to HTML. HTML tags in the Markdown are shown as text."""
    return Markup(mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])(text))


def ratio_and_far_off(row: dict[str, Any] | pd.Series) -> str:
    """Return `ratio` and the sequences far from the others: "3.85 (95 % CI 0.71-80.41),
    sequence 01 alone 95.20".
    """
    return ratio(row) + "".join(
        f", sequence {name} alone {number(row[name])}" for name in row["far_off"]
    )


TEMPLATES.filters["ratio"] = ratio_and_far_off
TEMPLATES.filters["number"] = number


def findings(
    runs: pd.DataFrame,
    table: pd.DataFrame,
    data: str,
    label_maps: list[dict[str, Any]] | tuple[()] = (),
    trainings: list[dict[str, Any]] | tuple[()] = (),
) -> str:
    """Return the findings of a run, a study or the evidence as Markdown.

    table: `compare.comparisons` of the runs. data: one line with the origin of the data.
    label_maps: the quality of the label maps, rows of `gap.label_map_quality`.
    trainings: what other trainings of the network give, from `trainings.summary`.
    """
    baseline, masked = runs[runs["method"] == "baseline"], runs[runs["method"] == "masked"]
    pairs = table[
        (table["method"] == "masked")
        & (table["reference"] == "masked")
        & table["metric"].isin(compare.JUDGING_METRICS)
        & (table["source"] < table["reference_source"])
        # each pair of sources once
        & (table["estimator"] == compare.judging_estimator(table))
    ]
    sources = [
        _source_values(runs, table, source)
        for source in compare.sources(runs) or [""]
        if (masked["source"] == source).any()
    ]
    spread = compare.shuffle_spread(runs).groupby("estimator")["factor"].agg(["median", "max"])
    return render(
        "findings.md.j2",
        label_maps=label_maps,
        trainings=trainings,
        deciding_metrics=list(compare.JUDGING_METRICS),
        data=data,
        embedded="embedded" in data.split(";")[0],
        frames=baseline.groupby("sequence")["frames"].first().to_dict(),
        repetitions=baseline["repetition"].nunique(),
        spread=spread.reindex(list(ESTIMATORS)).dropna().T.to_dict(),
        estimators=ESTIMATORS,
        methods=compare.METHODS,
        metrics=compare.METRICS,
        deciding=[
            compare.METRICS[name]
            for name in compare.JUDGING_METRICS
            if (table["metric"] == name).any()
        ],
        estimators_run=set(table["estimator"]),
        too_few=compare.TOO_FEW,
        fewest=compare.MIN_SEQUENCES,
        least=compare.MIN_FOR_INTERVAL,
        level=compare.LEVEL,
        far=compare.FAR_OFF,
        thesis_width=CONTROL_WIDTH,
        sources=sources,
        against_each_other=pairs.to_dict("records"),
    )


def _source_values(runs: pd.DataFrame, table: pd.DataFrame, source: str) -> dict[str, Any]:
    """Return the values of one source of masks for the template."""
    runs, judged = compare.of_source(runs, source), compare.primary_comparison(table, source)
    rows = table[(table["source"] == source) & (table["reference"] == "baseline") & table["tested"]]
    judging = rows["metric"].isin(compare.JUDGING_METRICS) & (
        rows["estimator"] == compare.judging_estimator(table)
    )
    controls = compare.against(table, compare.SEGMENTATION_FREE_CONTROLS, source)
    controls = controls[controls["reference_source"] == source].groupby("reference", sort=False)[
        "verdict"
    ]
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    tested, widths = compare.tested_width(runs), masked["dilation_width"].nunique()
    same_best = (
        thesis_tables.stability(masked, baseline)["same_best"].mean() if widths > 1 else pd.NA
    )
    return {
        "name": source,
        "judged": judged.to_dict("records"),
        "verdict": compare.overall(judged["verdict"]),
        "width": tested,
        "masked": rows[rows["method"] == "masked"].to_dict("records"),
        "corrected": rows[judging & (rows["method"] == "corrected")].to_dict("records"),
        "controls": controls.agg(compare.overall).to_dict(),
        "widths": widths,
        "same_best": None if pd.isna(same_best) else float(same_best),
    }


# Records of commands, for JSON and for templates


def run_record(result: Result, sequence: Sequence) -> dict[str, Any]:
    """Return the errors, keypoints, time and flags of an `odometry.Result`. An error that is
    not determined is None.
    """
    errors = dict.fromkeys(ERRORS)
    if sequence.has_truth:
        values = metrics.errors(result.poses, sequence.poses).values()
        errors = {
            name: None if value != value else value
            for name, value in zip(ERRORS, values, strict=True)
        }
    detected = result.frames["detected"].dropna()  # empty if no frame has structure
    seconds = result.frames.filter(like="_seconds").sum(axis=1)
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        **errors,
        "mean_keypoints": float(detected.mean()) if len(detected) else 0.0,
        "ms_per_frame": 1000 * float(seconds.mean()),
        "flagged": {flag: int(count) for flag, count in result.flagged.items()},
    }
