"""Figures and tables of chapter 4, the comparison and the findings show the numbers of the runs."""

from html import escape
from types import SimpleNamespace

import made_up
import numpy as np
import pandas as pd
import pytest
from cells import cells

from keypoint_study import comparisons, verdicts
from keypoint_study.path_errors import ERRORS
from keypoint_study.report import comparison, findings, html, style, texts
from thesis import REPORTED, chapter4, few_keypoints, tables
from thesis_repro.errors import one_line

ELEVEN = [f"{number:02d}" for number in range(11)]
CONTROLS = comparisons.SEGMENTATION_FREE_CONTROLS
NEVER_SHUFFLED = made_up.runs(
    ["00"], lambda *_: 1.0, {"baseline": [None]}, estimators=["thesis"], repetitions=1
)


UNREAD = comparisons.METRIC_TITLES.keys() - {"rmse", "mae", "se3", "rotation"}


def runs_of(names, errors, widths=(5, 10, 15), **options):
    methods = {"baseline": [None], "reduced": [None], "masked": widths} | {
        name: [10] for name in CONTROLS
    }
    return made_up.runs(names, errors, methods, **options).drop(columns=UNREAD)


def widths_of(runs):
    """The runs with masks and with all keypoints, as notebook 8 selects them."""
    return comparisons.of_method(runs, "masked"), comparisons.of_method(runs, "baseline")


def halved(name, method, _):
    """Errors that masks halve and controls do not."""
    return (0.5 if method == "masked" else 1.0) * (1 + int(name) / 10)


@pytest.mark.parametrize(
    "metric, key, total, mean, median, improved",
    [
        ("rmse", "table_4_2_rmse_percent_change", -13.2, -1.2, -5.27, 6),
        ("mae", "table_4_3_mae_percent_change", -25.65, -2.33, 1.76, 4),
    ],
)
def test_tables_of_the_thesiss_numbers_equal_the_thesiss(
    metric, key, total, mean, median, improved
):
    reported = REPORTED[key]
    runs = runs_of(
        list(reported),
        lambda name, method, width: (
            2.0
            if method == "baseline"
            else 2 * (1 + reported[name] / 100) + {5: 0.5, 15: 1.0}.get(width, 0)
        ),
    )
    table = tables.table_of_change(*widths_of(runs), NEVER_SHUFFLED, metric, "thesis").set_index(
        "sequence"
    )
    changes = [column for column in table if column.startswith("change")]
    assert len(changes) == 3  # no column for masks that did nothing
    for column in changes:
        assert table.loc["sum (the thesis's aggregate)", column] == pytest.approx(total, abs=0.06)
        assert table.loc[["mean", "median"], column].tolist() == pytest.approx(
            [mean, median], abs=0.05
        )
        assert table.loc["sequences improved", column] == improved
    widths = tables.table_4_1(widths_of(runs)[0], "thesis")
    assert set(widths["dilation width (pixels)"]) == {10} and widths["width, thesis"].tolist()[
        :2
    ] == [10, 11]


def test_errors_are_means_with_their_spread_and_the_lowest_is_bold():
    runs = runs_of(ELEVEN, halved, noise=0.2)
    table = comparison.table_of_errors(comparisons.comparisons_of(runs), runs).content
    methods = [
        "all keypoints",
        "masks, width 10",
        *(comparisons.METHOD_TITLES[name] for name in CONTROLS),
    ]
    parts = 2 * len(comparisons.JUDGING_METRICS)  # estimators and errors
    assert list(table["method"]) == parts * methods and list(table.columns[3:]) == ELEVEN
    assert list(table["estimator"].unique()) == ["thesis's estimator", "refined estimator"]
    errors = [f"{error.title} ({error.unit})" for error in ERRORS.values() if error.decides]
    assert list(table["error"].unique()) == errors
    masked = (runs["method"] == "masked") & (runs["dilation_width"] == 10)
    errors = runs[masked & (runs["estimator"] == "refined") & (runs["sequence"] == "03")]["se3"]
    cell = table[table["estimator"] == "refined estimator"].set_index("method").iloc[1]["03"]
    mean, spread = map(float, cell.strip("*").split(" ± "))
    assert (mean, spread) == pytest.approx((errors.mean(), errors.std()), abs=0.00051)
    bold = table[ELEVEN].map(lambda cell: cell.startswith("**"))
    of_masks = bold[table["method"] == "masks, width 10"]
    assert (bold.sum() == parts).all() and of_masks.to_numpy().mean() > 0.9
    own = runs[runs["method"] == "baseline"].assign(method="keypoints", source="mine")
    beside = pd.concat([runs_of(ELEVEN, halved, (10,), noise=0.2, sources=("net",)), own])
    shown = comparison.table_of_errors(comparisons.comparisons_of(beside), beside).content
    assert len(shown) == len(table) + parts and "mine" in set(shown["method"])
    once = runs[runs["repetition"] == 0]
    single = comparison.table_of_errors(comparisons.comparisons_of(once), once).content
    assert not single[ELEVEN].map(lambda cell: "±" in cell).any(axis=None)


def test_what_cannot_be_told_has_no_column():
    table = comparisons.comparisons_of(runs_of(ELEVEN[:2], halved, noise=0.2))
    few = comparison.table_of_ratios(comparison.all_of(table))
    assert verdicts.TOO_FEW not in few.to_string() and set(few["sequences"]) == {2}


def test_a_sequence_that_the_thesis_does_not_have_has_no_number_of_it():
    masked, all_keypoints = widths_of(runs_of(["77"], lambda *_: 1.0))
    changes = tables.table_of_change(masked, all_keypoints, NEVER_SHUFFLED, "rmse", "thesis")
    assert np.isnan(changes.loc[0, "change (%), thesis"])
    assert pd.isna(tables.table_4_1(masked, "thesis").loc[0, "width, thesis"])


@pytest.mark.parametrize(
    "low, high, text",
    [
        (0.98, 1.3, "1.09 (0.98-1.30)"),
        (1.00001, 1.3, "1.09 (1.00-1.30) ↑"),
        (0.2, 0.99999, "1.09 (0.20-1.00) ↓"),
        (float("nan"), float("nan"), "1.09"),
    ],
)
def test_a_ratio_has_two_digits_and_a_mark_if_its_interval_excludes_1(low, high, text):
    assert texts.short({"ratio": 1.0888, "low": low, "high": high}) == text


@pytest.mark.parametrize(
    "errors, names, verdict",
    [
        (halved, ELEVEN, verdicts.LOWER),
        (lambda *of: 1 / halved(*of), ELEVEN, verdicts.HIGHER),
        (lambda *_: 1.0, ELEVEN[:6], verdicts.NO_CLEAR_DIFFERENCE),
        (halved, ELEVEN[:5], verdicts.TOO_FEW),
    ],
)
@pytest.mark.parametrize("sources", [("",), ("net", "hand")])
def test_findings_follow_the_verdict(errors, names, verdict, sources):
    runs = runs_of(names, errors, (10,), noise=0.02, sources=sources, repetitions=1)
    table = comparisons.comparisons_of(runs)
    is_primary = (
        table["decides"] & (table["method"] == "masked") & (table["reference"] == "baseline")
    )
    primary = table[is_primary]
    for source in sources:
        assert comparisons.verdict_of(primary[primary["source"] == source]) == verdict
    text = findings.findings_of(runs, table, "KITTI folder embedded, made up", False)
    assert text.count(f"{findings.OUTCOMES[verdict]} here.**") == len(sources)
    for row in primary.to_dict("records"):
        assert f"| {texts.short(row)} |" in text
    too_few = verdict == verdicts.TOO_FEW
    assert text.count("too few to compare it with the controls") == too_few * len(sources)
    beaten = {verdicts.LOWER: len(CONTROLS)}.get(verdict, 0)
    told = f"lower than with {beaten} of {len(CONTROLS)} controls"
    assert text.count(told) == (not too_few) * len(sources)


def test_what_is_far_off_is_told_without_it():
    runs = runs_of(ELEVEN, halved, noise=0.02)
    runs.loc[(runs["sequence"] == "03") & (runs["method"] == "masked"), "se3"] *= 40
    text = findings.findings_of(runs, comparisons.comparisons_of(runs), "made up", False)
    assert "without 03, aligned ATE is 0.5" in text


@pytest.mark.slow
@pytest.mark.parametrize(
    "names, noise, sources",
    [
        (["00"], 0, ("",)),
        (["00", "05", "06"], 0, ("net", "by hand")),
        (ELEVEN, 0.9, ("",)),
        pytest.param(["00", "05"], 0.9, ("",), marks=pytest.mark.torture),
    ],
)
def test_figures_of_equal_and_of_noisy_errors_can_be_drawn(names, noise, sources):
    runs = runs_of(names, lambda *_: 0.1, noise=noise, sources=sources)
    table = comparisons.comparisons_of(runs)
    if sources == ("",):
        chapter4.figure_against_width(*widths_of(runs), "rmse").draw_without_rendering()
        figures = {}
        save = SimpleNamespace(
            save_figure=lambda figure, name, note: figures.update({name: figure})
        )
        given = {"runs": runs, "note": "", "artefacts": save, "tables": tables, "pd": pd}
        given |= {"chapter4": chapter4, "style": style}
        for number in ("58", "18", "26"):
            exec(cells("08_results.ipynb", "code")[f"08-{number}"], given)
        figures |= chapter4.figures_beside(given["masked"], given["baseline"], given["of_methods"])
        for drawn in figures.values():
            drawn.draw_without_rendering()
        assert set(figures) == {f"figure_4_{number:02d}" for number in (7, 10, 13, 14, 15, 16)}
    figure = comparison.figure_of_ratios(table).content
    figure.draw_without_rendering()
    assert all(edge > 0 for axes in figure.axes for edge in axes.get_xlim())


def test_the_comparison_figure_shows_ratios_and_their_interval():
    table = comparisons.comparisons_of(runs_of(ELEVEN, halved, (10,), noise=0.1))
    axes = comparison.figure_of_ratios(table).content.axes[0]
    row = table[
        (table["estimator"] == "thesis")
        & (table["metric"] == list(comparisons.JUDGING_METRICS)[0])
        & table["tested"]
        & (table["method"] == "masked")
        & (table["reference"] == "baseline")
    ].iloc[0]
    dots, interval, marker = axes.lines[:3]
    assert dots.get_xdata() == pytest.approx([row["ratios"][name] for name in ELEVEN])
    assert interval.get_xdata() == pytest.approx([row["low"], row["high"]])
    assert marker.get_xdata() == pytest.approx([row["ratio"]])
    # so that the ends of an interval shorter than the marker are seen
    assert interval.get_markersize() > 1.5 * marker.get_markersize()


def test_a_path_that_others_make_flat_has_its_own_scale():
    straight = np.arange(10.0)[:, None] * [0, 0, 1]
    sideways = np.linspace(0, 1, 10)[:, None] * [1, 0, 0]
    paths = {("00", "near"): straight + 0.1 * sideways, ("00", "far"): straight + 9 * sideways}
    paths[("00", "middle")] = straight + 4 * sideways
    row = {"sequence": "00", "method": "baseline", "repetition": 0, "frames": 10, "rmse": 0.1}
    row |= {"failed": 0, "lost": 0}
    heights = {}
    for run in ("near", "middle", "far"):
        rows = pd.DataFrame([row | {"run": run}])
        _, below = chapter4.figure_paths({"00": straight}, rows, paths).axes
        heights[run] = below.get_ylim()[1], below.get_title(loc="right") != ""
    own, shared = (1.05 * end * 8 / 9 for end in (0.1, 9))  # paths meet at frame 1
    assert heights["near"] == (pytest.approx(own), True)
    assert heights["middle"] == heights["far"] == (pytest.approx(shared), False)


def test_each_line_over_the_width_is_drawn_once_the_low_ones_apart():
    masked, baseline = widths_of(runs_of(ELEVEN, halved))
    figure = chapter4.figure_against_width(masked, baseline, "rmse")
    high, low = figure.subfigs[0].axes
    drawn = [[line.get_label() for line in panel.lines] for panel in (high, low)]
    assert drawn == [ELEVEN[5:], ELEVEN[:5]]
    for name, line in zip(drawn[0] + drawn[1], high.lines[:] + low.lines[:], strict=True):
        means = masked[masked["sequence"] == name].groupby("dilation_width")["rmse"].mean()
        assert list(line.get_ydata()) == pytest.approx(list(means))


def test_the_curve_of_few_keypoints_shows_every_ratio():
    rows = [
        {"choice": choice, "number": number, "keypoints": number or 1900, "estimator": estimator}
        | {"error": error, "ratio": 2.0, "low": 0.3, "high": 90.0 if number == 50 else 3.0}
        for choice, number in (("all", 0), ("strongest", 50), ("strongest", 400))
        for estimator in few_keypoints.COMPARED
        for error in comparisons.JUDGING_METRICS
    ]
    figure = few_keypoints.figure_of_few(pd.DataFrame(rows))
    assert len(figure.axes) == 2 * len(comparisons.JUDGING_METRICS)
    for panel in figure.axes:
        low, high = panel.get_ylim()
        assert low < 0.3 and high > 90
    near = [row | {"ratio": 1.1} for row in rows]  # they are drawn once more, enlarged
    figure = few_keypoints.figure_of_few(pd.DataFrame(near))
    enlarged = figure.axes[2::4] + figure.axes[3::4]
    assert {panel.get_ylim() for panel in enlarged} == {few_keypoints.NEAR}


HOSTILE = [
    "![a](http:x.png)",
    "![a][b]",
    "[a](http:x)",
    "__a__",
    "*a*",
    "`a`",
    "a|b",
    "<img src=x>",
    "a\\|b",
    "~~a~~",
    "=1+1",
    "NA",
    "007",
    "caf\udce9",
    "a\nb\r\x1b",
]


def test_names_stay_names_in_texts_and_tables(tmp_path):
    shown = [escape(one_line(name)) for name in HOSTILE]
    rows = pd.DataFrame({"sequence": HOSTILE, "masks": HOSTILE, "ate": -1.0})
    style.save_table(rows, tmp_path, "table", HOSTILE[0])
    read = html.from_markdown((tmp_path / "table.md").read_text(encoding="utf-8"))
    assert read.count("<td") == 3 * len(HOSTILE) and f"<p>{shown[0]}</p>" in read
    assert all(read.count(f">{name}</td>") == 2 for name in shown)
    # a spreadsheet must not calculate with it, and the page shows it as it is in the file
    table = pd.read_csv(tmp_path / "table.csv", dtype=str, keep_default_na=False)
    in_file = [name.encode(errors="backslashreplace").decode() for name in HOSTILE]
    in_file[HOSTILE.index("=1+1")] = "'=1+1"
    assert list(table["sequence"]) == list(table["masks"]) == in_file
