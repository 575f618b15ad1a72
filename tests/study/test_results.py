import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError
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


def test_runs_without_a_test_have_the_width_of_the_thesis_and_two_tests_have_none():
    summary = summary_of(ELEVEN, narrow_is_good)
    assert results.tested_width(summary[summary["estimator"] == "thesis"]) == 10
    both = pd.concat([summary, summary_of(ELEVEN, narrow_is_good, tested=5)])
    with pytest.raises(InputError, match="controls of the widths 5, 10; masks are put to the test at one"):
        results.tested_width(both)


# The words


# Figures


def test_time_savings_follow_equation_4_2():
    seconds = pd.DataFrame([(name, method, width, spent) for name in ("00", "01") for method, width, spent in
                            (("baseline", np.nan, 10.0), ("masked", 5, 9.0), ("masked", 10, 11.0))],
                           columns=["sequence", "method", "dilation_width", "seconds"])
    assert results.time_savings(seconds).to_dict() == pytest.approx({5: -10, 10: 10})


