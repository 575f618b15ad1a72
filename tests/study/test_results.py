import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError
from thesis_repro.report import findings, outcome, tables
from thesis_repro.report.captions import REPORTED
from thesis_repro.report.style import markdown
from thesis_repro.study import results
from thesis_repro.study.jobs import Job

ELEVEN = [f"{number:02d}" for number in range(11)]
OTHERS = [method for method in results.CONTROLS if method != "masked"]


def summary_of(names, errors, repetitions=5, noise=0.0, widths=(5, 10, 15), controls=OTHERS, seed=0, tested=10):
    """A summary of runs with made-up errors in metres.

    errors(sequence, method, width) -> RMSE, MAE is half of it. noise: relative spread of repetitions.
    tested: the width of the controls.
    """
    generator = np.random.default_rng(seed)
    runs = [("baseline", None, "thesis"), *(("masked", width, "thesis") for width in widths), ("reduced", None, "thesis"),
            ("baseline", None, "refined"), ("masked", tested, "refined")]
    runs += [(method, None if method in ("fewer", "spread") else tested, estimator)
             for method in controls for estimator in results.ESTIMATORS]
    rows = []
    for name in names:
        for method, width, estimator in runs:
            for repetition in range(repetitions):
                error = errors(name, method, width) * np.exp(noise * generator.normal())
                job = Job(name, method, width, estimator=estimator, repetition=repetition)
                rows.append({"sequence": name, "run": job.name, "method": method, "dilation_width": width,
                             "estimator": estimator, "repetition": repetition, "frames": 100, "rmse": error, "mae": error / 2,
                             "se3": error / 3, "translation_percent": 2 * error, "rotation_deg_per_m": error / 100,
                             "mean_keypoints": 2000 if method == "baseline" else 500 + (width or 10), "flagged": 0})
    return pd.DataFrame(rows).astype({"dilation_width": float})


def thesis_summary(reported):
    """Width 10 is the best and changes a baseline of 2 m by the thesis's percentages; so does every control."""
    def errors(name, method, width):
        return 2.0 if method == "baseline" else 2 * (1 + reported[name] / 100) + {5: 0.5, 15: 1.0}.get(width, 0)
    return summary_of(list(reported), errors)


def test_the_thesis_tables_come_out_of_the_thesis_numbers():
    reported = REPORTED["table_4_2_rmse_percent_change"]
    table = tables.table_of_change(thesis_summary(reported), "rmse", "thesis").set_index("sequence")
    ours, theirs = table["change (%)"], table["change (%), thesis"]
    # what the thesis calls aggregate is the sum; its mean is a tenth of that and its median lower still
    assert ours["sum (the thesis's aggregate)"] == theirs["sum (the thesis's aggregate)"] == -13.2
    assert (ours["mean"], ours["median"], ours["sequences improved"]) == (-1.2, -5.27, 6)
    assert ours["05"] == theirs["05"] == 67.56
    low, high = ours["mean, 95 % interval, from"], ours["mean, 95 % interval, to"]
    assert -25 < low < -15 and 15 < high < 25  # the thesis's mean cannot be told apart from zero
    widths = tables.table_4_1(thesis_summary(reported), "thesis")
    assert set(widths["dilation width (pixels)"]) == {10}
    assert widths["mean keypoints, thesis"].tolist()[:2] == [788, 500]


def test_the_mae_table_has_the_thesis_mae():
    reported = REPORTED["table_4_3_mae_percent_change"]
    table = tables.table_of_change(thesis_summary(reported), "mae", "thesis").set_index("sequence")
    for column in ("change (%)", "change (%), thesis", "width 10 (%)", "mirrored (%)"):
        assert table.loc["sum (the thesis's aggregate)", column] == pytest.approx(-25.65, abs=0.06)
        assert table.loc["median", column] == pytest.approx(1.76, abs=0.05)
        assert table.loc["sequences improved", column] == 4


def test_what_no_constant_angle_moves_stands_beside_rmse():
    summary = summary_of(["00", "01", "02", "03"], lambda name, method, width: 1.0 if method == "baseline" else 0.5)
    summary.loc[summary["method"] != "baseline", "se3"] *= 3  # the angle was all that masks made better
    summary.loc[summary["sequence"] == "03", "translation_percent"] = np.nan  # too short
    summary["rotation_deg_per_m"] = np.nan  # all of them
    table = tables.table_of_change(summary, "rmse", "thesis").set_index("sequence")
    assert table.loc["00", ["change (%)", "aligned ATE (%)", "translation over 20 m (%)"]].tolist() == [-50, 50, -50]
    assert pd.isna(table.loc["03", "translation over 20 m (%)"]) and table.loc["mean", "aligned ATE (%)"] == 50
    shown = tables.table_controls(summary).set_index("keypoints")
    assert shown["aligned ATE (%)"]["segmentation mask, width 10"].iloc[0] == "+50.0 (+50.0 to +50.0)"
    assert shown["translation over 20 m (%)"]["mirrored mask"].iloc[0] == "-50.0 (-50.0 to -50.0)"
    assert shown["rotation over 20 m (%)"].drop("all keypoints").isna().all()
    for written in (tables.table_sources, tables.table_errors):  # a source by its name
        named = summary[summary["method"].isin(["baseline", "masked"])].assign(
            source=lambda rows: np.where(rows["method"] == "masked", "net", ""))
        text = markdown(written(named))
        assert "nan" not in text and "50" in text
    text = findings.words(summary, "made up")
    assert "estimator: aligned ATE 1.50 (1.50 to 1.50) times, translation over 20 m 0.50 (0.50 to 0.50) times." in text
    assert "rotation over" not in text


def test_a_sequence_that_the_thesis_does_not_report_stays_empty():
    table = tables.table_of_change(summary_of(["77"], lambda *_: 1.0), "rmse", "thesis")
    assert table.set_index("sequence").loc["77", "change (%), thesis"] is np.nan or table.isna().iloc[0, 6]
    assert pd.isna(tables.table_4_1(summary_of(["77"], lambda *_: 1.0), "thesis").loc[0, "width, thesis"])


def test_repetitions_are_averaged_before_changes_are_taken_and_their_range_is_shown():
    summary = summary_of(["00"], lambda *_: 1.0)
    baseline = (summary["method"] == "baseline") & (summary["estimator"] == "thesis")
    summary.loc[baseline, "rmse"] = [1, 2, 3, 4, 10]
    row = tables.table_of_change(summary, "rmse", "thesis").iloc[0]
    assert row["RMSE, all keypoints (m)"] == 4 and row["all keypoints, range"] == "1 to 10"
    assert row["change (%)"] == -75


# The interval


def test_the_interval_covers_the_true_mean_about_as_often_as_it_says():
    generator = np.random.default_rng(1)
    covered = 0
    for _ in range(300):
        low, high = results.interval(generator.normal(7, 30, 11))
        covered += low <= 7 <= high
    assert 0.85 < covered / 300 < 0.98  # a percentile bootstrap of eleven is a little too narrow


def test_the_interval_moves_with_the_values_and_ignores_their_order():
    values = np.random.default_rng(2).normal(0, 10, 11)
    low, high = results.interval(values)
    assert low < values.mean() < high
    assert results.interval(values) == (low, high)
    assert results.interval(values * 2 + 5) == pytest.approx((low * 2 + 5, high * 2 + 5))
    assert results.interval(values[::-1]) == pytest.approx((low, high), abs=0.5)
    assert results.interval([*values, np.nan]) == (low, high)


def test_fewer_than_three_sequences_have_no_interval():
    assert np.isnan(results.interval([1.0, 2.0])).all() and np.isnan(results.interval([])).all()
    table = tables.table_of_change(summary_of(["00", "01"], lambda *_: 1.0), "rmse", "thesis")
    row = table.set_index("sequence").loc["mean, 95 % interval, from (too few sequences)"]
    assert np.isnan(row["change (%)"]) and row["change (%), thesis"] < -15


# The choice of width


def own_optimum(name, method, width):
    """Each sequence has a width of its own that is good for it alone."""
    if method != "masked":
        return 1.0
    return 0.5 if width == 1 + int(name) else 1.2 + 0.01 * width


def test_the_best_width_looks_good_where_the_left_out_one_shows_it_is_not():
    table = results.widths(summary_of(ELEVEN, own_optimum, widths=range(1, 16)))
    assert table["best"].tolist() == list(range(1, 12)) and np.allclose(table["best_rmse"], -50)
    assert (table["left_out"] != table["best"]).all() and (table["left_out_rmse"] > 20).all()
    assert table["fixed"].nunique() == 1 and (table["fixed_rmse"] < 0).sum() == 1
    assert np.allclose(table["left_out_rmse"], table["left_out_mae"])


def test_leaving_one_out_never_sees_its_own_sequence():
    summary = summary_of(ELEVEN, own_optimum, widths=range(1, 16), noise=0.3)
    chosen = results.chosen_widths(summary)
    for name in ("00", "04"):
        other = summary.copy()
        own = (other["sequence"] == name) & (other["method"] == "masked")
        other.loc[own, "rmse"] = np.random.default_rng(5).uniform(0.01, 50, own.sum())
        assert results.chosen_widths(other).loc[name, "left_out"] == chosen.loc[name, "left_out"]
        alone = results.chosen_widths(summary[summary["sequence"] != name])
        assert chosen.loc[name, "left_out"] == alone["fixed"].iloc[0]


def test_the_best_width_is_that_of_the_runs():
    summary = summary_of(ELEVEN, own_optimum, widths=range(1, 16), noise=0.5)
    best = results.best_widths(summary)
    assert results.widths(summary)["best"].tolist() == best["dilation_width"].tolist()
    rows = results.of_best_width(summary)
    assert len(rows) == 55 and np.allclose(rows.groupby("sequence")["rmse"].mean(), best["rmse"])


def test_a_real_optimum_is_found_again_in_other_repetitions_and_luck_is_not():
    real = results.stability(summary_of(ELEVEN, own_optimum, widths=range(1, 16), noise=0.05))
    assert (real["same_best"] == 100).all() and np.allclose(real["elsewhere"], -50, atol=6)
    luck = results.stability(summary_of(ELEVEN, lambda *_: 1.0, widths=range(1, 16), noise=0.2))
    assert luck["same_best"].mean() < 20 and abs(luck["elsewhere"].mean()) < 10
    assert results.widths(summary_of(ELEVEN, lambda *_: 1.0, widths=range(1, 16), noise=0.2))["best_rmse"].mean() < -10
    assert results.stability(summary_of(ELEVEN, own_optimum, repetitions=1)).isna().all(axis=None)


def test_a_width_that_failed_in_one_sequence_is_not_chosen_for_all():
    summary = summary_of(["00", "01", "02"], lambda name, method, width: 0.1 if width == 15 else 1.0)
    failed = (summary["sequence"] == "01") & (summary["dilation_width"] == 15) & (summary["method"] == "masked")
    chosen = results.chosen_widths(summary[~failed])
    assert set(chosen["fixed"]) == {5} and chosen["left_out"].tolist() == [5, 15, 5]
    assert np.isnan(results.widths(summary[~failed]).loc["01", "left_out_rmse"])


# The controls


def segmentation_matters(name, method, width):
    return (0.5 if method == "masked" else 1.0) * (1 + int(name) / 10)


def edges_do_as_well(name, method, width):
    return (0.5 if method in ("masked", "image-edges") else 1.0) * (1 + int(name) / 10)


def test_controls_are_compared_within_their_estimator():
    summary = summary_of(ELEVEN, segmentation_matters)
    summary.loc[summary["estimator"] == "refined", "rmse"] *= 0.1
    table = results.controls(summary).set_index(["estimator", "method"])
    assert len(table) == 2 * 11
    for estimator in results.ESTIMATORS:
        assert table.loc[(estimator, "masked"), "rmse"] == pytest.approx(-50)
        assert table.loc[(estimator, "mirrored"), ["rmse", "rmse_minus"]].tolist() == pytest.approx([0, -50])
        assert table.loc[(estimator, "masked"), "rmse_improved"] == 11
    assert table.loc[("thesis", "masked"), "keypoints"] == 510


def test_the_spread_over_repetitions_is_of_the_mean_over_sequences():
    summary = summary_of(["00", "01"], lambda *_: 1.0, repetitions=2)
    rows = (summary["method"] == "mirrored") & (summary["estimator"] == "thesis") & (summary["repetition"] == 1)
    summary.loc[rows, "rmse"] = [3.0, 2.0]
    row = results.controls(summary).set_index(["estimator", "method"]).loc[("thesis", "mirrored")]
    assert (row["rmse_lowest"], row["rmse_highest"], row["rmse"]) == (0, 150, 75)


def narrow_is_good(name, method, width):
    """Masks of width 5 halve the error, wider ones double it."""
    return (1.0 if method != "masked" else 0.5 if width == 5 else 2.0) * (1 + int(name) / 10)


def test_the_width_that_is_tested_is_that_of_the_runs():
    summary = summary_of(ELEVEN, narrow_is_good, noise=0.02, tested=5)
    assert results.tested_width(summary) == 5 and (results.keypoints_left(summary) == 505).all()
    for estimator in results.ESTIMATORS:
        assert set(results.of_control(summary, "masked", estimator)["dilation_width"]) == {5}
        assert results.control_changes(summary, "rmse", estimator)["masked"].mean() == pytest.approx(-50, abs=3)
    table = tables.table_of_change(summary, "rmse", "thesis").set_index("sequence")
    assert table.loc["00", "width 5 (%)"] == pytest.approx(-50, abs=3) and "width 10 (%)" not in table
    assert "segmentation mask, width 5" in set(tables.table_controls(summary)["keypoints"])
    figure = outcome.figure_controls(summary)
    assert "segmentation mask, width 5" in [tick.get_text() for tick in figure.axes[0].get_yticklabels()]
    plt.close(figure)
    text = findings.words(summary, "made up")
    assert text.count("masks of width 5 make RMSE 0.5") == 2 and "in place of Section 3.6's 10" in text
    assert text.count("**Masks help here, and the segmentation matters") == 2


def test_runs_without_a_test_have_the_width_of_the_thesis_and_two_tests_have_none():
    summary = summary_of(ELEVEN, narrow_is_good)
    assert results.tested_width(summary[summary["estimator"] == "thesis"]) == 10
    both = pd.concat([summary, summary_of(ELEVEN, narrow_is_good, tested=5)])
    with pytest.raises(InputError, match="controls of the widths 5, 10; masks are put to the test at one"):
        results.tested_width(both)


# The words


def test_words_follow_the_numbers():
    text = findings.words(summary_of(ELEVEN, segmentation_matters, noise=0.02), "made up")
    assert "made up" in text and "11 sequences (00, 01" in text and "KITTI" not in text
    assert text.count("**Masks help here, and the segmentation matters") == 2
    text = findings.words(summary_of(ELEVEN, edges_do_as_well, noise=0.02), "made up")
    assert "is not shown to matter: not shown to do worse are edges of the image.**" in text
    text = findings.words(summary_of(ELEVEN, lambda *_: 1.0), "made up")
    assert text.count("**Masks are not shown to help here, and the segmentation is not shown to matter") == 2
    text = findings.words(summary_of(ELEVEN, lambda *a: 1 / segmentation_matters(*a), noise=0.02), "made up")
    assert text.count("**Masks do worse than all keypoints here, and the segmentation is not shown to matter") == 2


def test_a_verdict_never_stands_without_the_quality_of_the_label_maps():
    text = findings.words(summary_of(ELEVEN, lambda *a: 1 / segmentation_matters(*a), noise=0.02),
                          "odometry: embedded world (rendered); training: made up", "label maps: mean IoU 0.21",
                          "mean IoU 0.21")
    short = text.split("\n\n")[0]
    assert "Label maps: mean IoU 0.21." in short and "nothing here is evidence about KITTI" in short
    assert short.count("Masks from label maps of mean IoU 0.21 do worse") == 2


def test_one_sequence_carries_no_ratio():
    """Ten times the error in one of eleven sequences: +82 % as a mean of percentages, 1.23 times as a ratio."""
    text = findings.words(summary_of(ELEVEN, lambda name, method, _: 10.0 if (name, method) == ("03", "masked")
                                     else 1.0, noise=0.01), "made up")
    assert text.count("masks of width 10 make RMSE 1.2") == 2
    assert text.count("Masks are not shown to help here") == 2
    rows = [line for line in text.splitlines() if line.startswith("| segmentation mask, width 10")]
    assert len(rows) == 1 and rows[0].count("1.2") == 2


def test_it_is_said_where_the_tested_width_comes_from():
    text = findings.words(summary_of(ELEVEN, narrow_is_good), "made up")
    assert "that of Section 3.6, fixed before any run; it is the best width of no sequence." in text
    text = findings.words(thesis_summary(REPORTED["table_4_2_rmse_percent_change"]), "made up")
    assert "is 10, that of Section 3.6, fixed before any run.\n" in text and "of no sequence" not in text


def test_noise_is_not_taken_for_a_result():
    for seed in range(5):
        text = findings.words(summary_of(ELEVEN, lambda *_: 1.0, noise=0.3, seed=seed), "made up")
        assert "the segmentation matters" not in text and "looks good even where masks do nothing" in text


def test_words_about_few_sequences_settle_nothing():
    text = findings.words(summary_of(["00", "05", "06"], segmentation_matters, noise=0.02), "made up")
    assert "**Masks" not in text.split("\n\n")[0] and text.count("3 sequences cannot tell whether masks help") == 2


def test_one_sequence_and_missing_variants_are_handled():
    summary = summary_of(["00"], own_optimum, repetitions=1, controls=["mirrored", "fewer"])
    assert set(results.control_changes(summary, "rmse")) == {"masked", "mirrored", "fewer"}
    text = findings.words(summary, "made up")
    assert "1 sequence cannot tell" in text and "true label maps" not in text and "nan" not in text.lower()
    table = tables.table_widths(summary).set_index("sequence")
    assert np.isnan(table.loc["00", "left-out: width"])
    assert "true (%)" not in tables.table_of_change(summary, "rmse", "thesis")
    assert "nan" not in markdown(tables.table_controls(summary)).lower()
    without = summary[~((summary["estimator"] == "refined") & (summary["method"] == "baseline"))]
    assert "refined estimator" not in findings.words(without, "made up")


def test_thesis_runs_alone_give_tables_and_words():
    summary = summary_of(["00", "01", "02"], own_optimum, controls=[])
    summary = summary[summary["estimator"] == "thesis"]
    assert "other controls" not in findings.words(summary, "made up")
    assert len(tables.table_controls(summary)) == 2


# Figures


def test_paths_of_all_repetitions_are_drawn_and_the_first_is_bold():
    rows = results.of_method(summary_of(["00", "05"], lambda *_: 1.0, noise=0.2), "baseline")
    paths = {(row.sequence, row.run): np.full((4, 3), row.repetition) for row in rows.itertuples()}
    truths = {name: np.zeros((4, 3)) for name in ("00", "05")}
    figure = outcome.figure_paths(truths, rows[::-1], paths, "baseline", "All keypoints")
    true, *lines = figure.axes[0].lines
    assert len(lines) == 5 and len(figure.axes) == 2
    assert lines[0].get_xdata()[0] == 0 and all(lines[0].get_linewidth() > line.get_linewidth() for line in lines[1:])
    plt.close(figure)


@pytest.mark.parametrize("names", [["00"], ["00", "05", "06"], ELEVEN])
def test_every_figure_can_be_drawn_and_names_its_units(names):
    summary = summary_of(names, own_optimum, noise=0.9)
    made = [outcome.figure_4_07(summary), outcome.figure_controls(summary)]
    made += [draw(summary, "rmse") for draw in (outcome.figure_against_width, outcome.figure_comparison,
                                                outcome.figure_breakdown)]
    for figure in made:
        figure.draw_without_rendering()
        labels = " ".join(axes.get_xlabel() + axes.get_ylabel() for axes in figure.axes)
        assert "(m)" in labels or "(%)" in labels or "(pixels)" in labels
        plt.close(figure)


def test_bars_reach_from_the_lowest_to_the_highest_repetition():
    summary = summary_of(["00"], lambda *_: 1.0)
    rows = (summary["method"] == "baseline") & (summary["estimator"] == "thesis")
    summary.loc[rows, "rmse"] = [1, 2, 3, 4, 10]
    figure = outcome.figure_comparison(summary, "rmse")
    (segment,) = figure.axes[0].collections[0].get_segments()
    assert segment[:, 1].tolist() == [1, 10] and figure.axes[0].patches[0].get_height() == 4
    plt.close(figure)


# Time


def test_time_savings_follow_equation_4_2():
    seconds = pd.DataFrame([(name, method, width, spent) for name in ("00", "01") for method, width, spent in
                            (("baseline", np.nan, 10.0), ("masked", 5, 9.0), ("masked", 10, 11.0))],
                           columns=["sequence", "method", "dilation_width", "seconds"])
    assert results.time_savings(seconds).to_dict() == pytest.approx({5: -10, 10: 10})


def test_the_budget_adds_up():
    measured = pd.DataFrame([(method, stage, 10.0) for method, stages in
                             (("all keypoints", ("read", "detection", "tracking", "pose")),
                              ("masked, width 10", tuple(outcome.STAGES))) for stage in stages],
                            columns=["method", "stage", "milliseconds"])
    overlapped = pd.DataFrame({"method": ["masked, width 10", "all keypoints"], "milliseconds": [25.0, 20.0]})
    table = tables.table_budget(measured, overlapped).set_index("stage")
    assert table.loc["all stages (ms)"].tolist() == [40, 60] and table.loc["frames a second"].tolist() == [25, 16.7]
    assert table.loc["between frames, overlapped (ms)"].tolist() == [20, 25]
    assert np.isnan(table.loc["segmentation (ms)", "all keypoints"])
    figure = outcome.figure_budget(measured, overlapped)
    assert sum(patch.get_width() for patch in figure.axes[0].patches) == 100
    plt.close(figure)


def test_markdown_table_aligns_numbers_and_leaves_missing_ones_empty():
    table = pd.DataFrame({"a": ["x", "y"], "b": [1.5, np.nan]})
    assert markdown(table) == "| a | b |\n| :--- | ---: |\n| x | 1.5 |\n| y |  |\n"
