"""Texts are templates (templates/*.j2) with numbers put in; their only conditions are what was run and the verdicts.

The findings are written from the table of `compare.comparisons`; those of a run, of a study with masks of one's own and
of the evidence on real frames come from one template.
"""

import re
from math import ceil, log10
from pathlib import Path

import mistune
import pandas as pd
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

from thesis_repro.study import compare, thesis_tables
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS

DIGITS = 2  # of a ratio, where no more are needed to tell it from 1
TEMPLATES = Environment(loader=FileSystemLoader(Path(__file__).parent / "templates"),
                        autoescape=lambda name: ".html" in (name or ""), undefined=StrictUndefined, trim_blocks=True,
                        lstrip_blocks=True)


def render(template, **values):
    """The text of a template in the folder templates; Markdown has one empty line at once, at most."""
    text = TEMPLATES.get_template(template).render(values).strip() + "\n"
    return re.sub(r"\n{3,}", "\n\n", text) if ".md" in template else text


def number(value):
    """A ratio with two digits, or as many as it takes to see that it is not 1."""
    near = 0 < abs(value - 1) < 0.5 * 10**-DIGITS
    return f"{value:.{min(6, ceil(-log10(abs(value - 1))) + 1) if near else DIGITS}f}"


def ratio(row):
    """"1.09 (95 % CI 0.98-1.32)" from a row with ratio, low and high; the ratio alone where there is no interval."""
    if pd.isna(row["low"]):
        return number(row["ratio"])
    return f"{number(row['ratio'])} ({compare.LEVEL} % CI {number(row['low'])}-{number(row['high'])})"


class _Renderer(mistune.HTMLRenderer):
    def heading(self, text, level, **attributes):
        return super().heading(text, max(4, level + 1), **attributes)  # below those of the page


def html(text):
    """Markdown as HTML; HTML in it is shown as text."""
    return Markup(mistune.create_markdown(renderer=_Renderer(escape=True), plugins=["table"])(text))


def ratio_and_far_off(row):
    """`ratio`, and each sequence that is far from the others: "3.85 (95 % CI 0.71-80.41), sequence 01 alone 95.20"."""
    return ratio(row) + "".join(f", sequence {name} alone {number(row[name])}" for name in row["far_off"])


TEMPLATES.filters["ratio"] = ratio_and_far_off
TEMPLATES.filters["number"] = number


def findings(runs, table, data, label_maps=()):
    """What the runs show, as Markdown.

    runs: with `compare.comparisons` of them, the table. data: one line that says where they come from.
    label_maps: how good these are, rows of `gap.label_map_quality`.
    """
    baseline, of_masks = runs[runs["method"] == "baseline"], runs[runs["method"] == "masked"]
    pairs = table[(table["method"] == "masked") & (table["reference"] == "masked")
                  & table["metric"].isin(compare.JUDGING_METRICS) & (table["source"] < table["reference_source"])
                  & (table["estimator"] == compare.judging_estimator(table))]  # each pair of sources once
    sources = [_of_source(runs, table, source) for source in compare.sources(runs) or [""]
               if (of_masks["source"] == source).any()]
    spread = compare.shuffle_spread(runs).groupby("estimator")["factor"].agg(["median", "max"])
    return render(
        "findings.md.j2", label_maps=label_maps, data=data,
        embedded="embedded" in data.split(";")[0], frames=baseline.groupby("sequence")["frames"].first().to_dict(),
        repetitions=baseline["repetition"].nunique(), spread=spread.reindex(list(ESTIMATORS)).dropna().T.to_dict(),
        estimators=ESTIMATORS, methods=compare.METHODS, metrics=compare.METRICS, fewest=compare.MIN_SEQUENCES,
        least=compare.MIN_FOR_INTERVAL, level=compare.LEVEL, far=compare.FAR_OFF, thesis_width=CONTROL_WIDTH,
        sources=sources, against_each_other=pairs.to_dict("records"))


def _of_source(runs, table, source):
    """What the template says of one source of masks."""
    runs, judged = compare.of_source(runs, source), compare.primary_comparison(table, source)
    rows = table[(table["source"] == source) & (table["reference"] == "baseline") & table["tested"]]
    judging = rows["metric"].isin(compare.JUDGING_METRICS) & (rows["estimator"] == compare.judging_estimator(table))
    controls = compare.against(table, compare.SEGMENTATION_FREE_CONTROLS, source)
    controls = controls[controls["reference_source"] == source].groupby("reference", sort=False)["verdict"]
    masked, baseline = compare.of_method(runs, "masked"), compare.of_method(runs, "baseline")
    tested, widths = compare.tested_width(runs), masked["dilation_width"].nunique()
    same_best = thesis_tables.stability(masked, baseline)["same_best"].mean() if widths > 1 else None
    return {"name": source, "judged": judged.to_dict("records"), "verdict": compare.overall(judged["verdict"]),
            "width": tested, "masked": rows[rows["method"] == "masked"].to_dict("records"),
            "corrected": rows[judging & (rows["method"] == "corrected")].to_dict("records"),
            "controls": controls.agg(compare.overall).to_dict(), "widths": widths,
            "same_best": None if pd.isna(same_best) else float(same_best)}
