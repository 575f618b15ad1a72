"""Comparisons of made-up runs: known ratios, intervals and verdicts.

Also Equation 4.1 and the choice of the dilation width.
"""

import made_up
import numpy as np
import pandas as pd
import pytest
from scipy.stats import ttest_1samp, wilcoxon

from keypoint_study import comparisons, ratios
from keypoint_study.path_errors import ERRORS, path_errors
from keypoint_study.report import comparison
from thesis import tables

EIGHT = [f"{number:02d}" for number in range(8)]


def runs_of(factors, sequences=EIGHT, width=10, **options):
    """Runs by {method: factor on the error of all keypoints, or a function of the sequence}."""

    def error(name, method, _):
        factor = factors.get(method, 1.0)
        if callable(factor):
            factor = factor(name)
        return (1 + int(name)) * factor

    widths = {"baseline": [None]} | {method: [width] for method in factors}
    return made_up.runs(sequences, error, widths, sources=["net"], **{"repetitions": 2} | options)


def arms(runs, *methods):
    return [runs[runs["method"] == method] for method in methods]


def primary(table):
    """The rows that answer whether masks help."""
    is_masked = (table["method"] == "masked") & (table["reference"] == "baseline")
    return table[table["decides"] & is_masked]


def ratio_of(rows, reference):
    return ratios.typical_ratio(ratios.ratios_of(rows, reference, "rmse"))


def test_each_error_is_zero_for_the_truth_and_no_other_path():
    """A new error with rows and columns of poses swapped fails here."""
    true = made_up.winding(150)
    right, wrong = path_errors(true, true), path_errors(made_up.winding(150, seed=0), true)
    for name in ERRORS:
        assert abs(right[name]) < 1e-4 < 1e-3 < wrong[name], name


def test_known_ratios_are_found_and_inverted_by_swapping():
    masked, baseline = arms(runs_of({"masked": 0.5}, noise=0.3), "masked", "baseline")
    forth, back = ratio_of(masked, baseline), ratio_of(baseline, masked)
    assert forth["ratio"] == pytest.approx(0.5, rel=0.3) and forth["n"] == 8
    assert forth["ratio"] * back["ratio"] == pytest.approx(1)
    assert (forth["low"] * back["high"], forth["high"] * back["low"]) == pytest.approx((1, 1))
    exact = ratio_of(*arms(runs_of({"masked": 0.25}), "masked", "baseline"))
    assert exact["low"] <= exact["ratio"] <= exact["high"]
    assert (exact["low"], exact["ratio"], exact["high"]) == pytest.approx((0.25, 0.25, 0.25))


@pytest.mark.parametrize("bad", [np.nan, 0.0])
def test_a_missing_or_zero_error_leaves_its_sequence_out(bad):
    runs = runs_of({"masked": 0.5})
    runs.loc[(runs["sequence"] == "03") & (runs["method"] == "masked"), "rmse"] = bad
    result = ratio_of(*arms(runs, "masked", "baseline"))
    assert result["n"] == 7 and result["ratio"] == pytest.approx(0.5)
    assert np.isnan(ratios.typical_ratio([np.nan])["ratio"])


@pytest.mark.parametrize(
    "factor, verdict",
    [
        (0.5, "lower"),
        (2.0, "higher"),
        (1.0, "no clear difference"),
        (lambda name: 2.0 ** (int(name) % 2 * 2 - 1), "no clear difference"),
    ],
)
def test_the_verdict_follows_the_interval(factor, verdict):
    masked, baseline = arms(runs_of({"masked": factor}), "masked", "baseline")
    for last, word in (("06", verdict), ("05", "too few sequences to tell")):
        runs = pd.concat([masked, baseline])
        row = primary(comparisons.comparisons_of(runs[runs["sequence"] < last])).iloc[0]
        assert (row["n"], row["verdict"]) == (int(last), word)


@pytest.mark.torture
def test_intervals_that_exclude_the_true_ratio_by_chance():
    """Print the percentages of docs/reading-results.md.

    Call it with pytest -m torture -s -k by_chance tests/keypoint_study.
    """
    random = np.random.default_rng(0)
    draws = {
        "normal": lambda shape: random.normal(size=shape),
        "heavy tails": lambda shape: random.standard_t(3, shape),
        "either fails": lambda shape: fails(shape, 1 / 6) * random.choice([-1, 1], shape),
        "one fails": lambda shape: fails(shape, 1 / 6),
        "5 % everywhere": lambda shape: random.normal(0.05, 0.05, shape),
        "5 % everywhere, one fails": lambda shape: on_first(random.normal(0.05, 0.05, shape)),
    }

    def fails(shape, share):
        """Logarithms of ratios near 1, or near 12 for a share of the sequences."""
        return random.normal(0, 0.1, shape) + 2.5 * (random.random(shape) < share)

    def on_first(logarithms):
        logarithms[:, 0] += 2.5
        return logarithms

    percent = {}
    for name, draw in draws.items():
        for count in (6, 8, 11):
            studies = draw((2000, count))
            for kind in ("typical", "mean"):
                interval = {"typical": ratios.typical_interval, "mean": ratios.mean_interval}
                ends = np.array([interval[kind](row)[-2:] for row in studies])
                excluded = (ends[:, 0] > 0) | (ends[:, 1] < 0)
                percent[name, kind, count] = 100 * excluded.mean()
    print(pd.Series(percent).unstack([1, 2]).round().astype(int).to_string())
    for name in ("normal", "heavy tails", "either fails"):
        assert all(percent[name, "typical", count] < 6 for count in (6, 8, 11))
    few, hidden = "5 % everywhere", "5 % everywhere, one fails"
    assert percent[few, "typical", 8] > 50 < percent[hidden, "typical", 8]
    assert percent[few, "mean", 8] > 50 > 1 > percent[hidden, "mean", 8]


def test_a_small_loss_everywhere_shows_beside_one_sequence_that_fails():
    of_streets = [1.024, 15.95, 1.171, 1.012, 1.014, 1.017, 1.101, 1.033]
    result = ratios.typical_ratio(of_streets)
    assert 1.0 < result["low"] < result["ratio"] < 1.2
    assert result["above"] == result["n"] == 8
    assert result["mean"] > 1.4 and result["mean_low"] < 1 < result["mean_high"]
    assert ratios.typical_ratio([1.0, 2.0])["above"] == 1


@pytest.mark.parametrize("n", [6, 8, 11])
def test_the_interval_holds_what_the_signed_rank_test_does_not_reject(n):
    values = np.random.default_rng(n).normal(0.3, 1, n)
    estimate, *ends = ratios.typical_interval(values)
    narrow = np.log(ratios.narrow_interval(np.exp(values)))
    assert ends[0] < narrow[0] < estimate < narrow[1] < ends[1]
    for (low, high), level in ((ends, 0.05), (narrow, 0.1)):
        for centre, rejected in ((low, -1), (high, 1)):
            for side in (-1, 1):
                p = wilcoxon(values - (centre + side * 1e-9), method="exact").pvalue
                assert (p <= level) == (side == rejected)


def test_failures_are_counted_and_compared_apart():
    runs = runs_of({"masked": 1.0})
    is_masked = runs["method"] == "masked"
    one_street = is_masked & (runs["sequence"] == "01")
    runs.loc[one_street, "failed"] = 10.0
    row = primary(comparisons.comparisons_of(runs)).iloc[0]
    assert (row["failed"], row["reference_failed"]) == ("1 of 8", "0 of 8")
    assert (row["more_failures"], row["fewer_failures"]) == (1, 0)
    assert row["failures_verdict"] == row["verdict"] == "no clear difference"
    runs.loc[is_masked & (runs["sequence"] < "06"), "lost"] = 1
    row = primary(comparisons.comparisons_of(runs)).iloc[0]
    assert (row["more_failures"], row["failures_verdict"]) == (6, "higher")  # 2 / 2**6
    swapped = comparisons.failures(
        pd.Series([False] * 6, range(6)), pd.Series([True] * 6, range(6))
    )
    assert swapped["failures_verdict"] == "lower" and swapped["fewer_failures"] == 6
    few = comparisons.failures(pd.Series([True], ["00"]), pd.Series([False], ["00"]))
    assert few["failures_verdict"] == "too few sequences to tell"


def test_the_interval_is_students_t():
    values = np.random.default_rng(1).normal(3, 10, 11)
    low, high = ratios.mean_interval([*values, np.nan])
    assert (low, high) == pytest.approx(tuple(ttest_1samp(values, 0).confidence_interval(0.95)))
    assert np.isnan(ratios.mean_interval([1.0, 2.0, np.nan])).all()


def test_masks_are_compared_with_all_keypoints_and_every_control():
    factors = {"masked": 0.5, "mirrored": 1.0, "fewer": 0.25, "reduced": 3.0}
    table = comparisons.comparisons_of(runs_of(factors))
    pairs = set(zip(table["method"], table["reference"]))
    assert pairs == {
        ("baseline", "baseline"),
        ("masked", "baseline"),
        ("mirrored", "baseline"),
        ("fewer", "baseline"),
        ("masked", "mirrored"),
        ("masked", "fewer"),
    }
    rows = table[table["metric"] == "rmse"].set_index(["method", "reference", "estimator"])
    assert rows.loc[("masked", "fewer", "refined"), "ratio"] == pytest.approx(2)
    of_sequences = rows.loc[("masked", "mirrored", "thesis"), "ratios"]
    assert of_sequences == pytest.approx(dict.fromkeys(EIGHT, 0.5))
    deciding = primary(table)
    assert set(deciding["estimator"]) == {"refined"}
    assert list(deciding["metric"]) == list(comparisons.JUDGING_METRICS)
    assert comparisons.verdict_of(deciding) == "lower"
    alone = runs_of(factors, estimators=["inliers", "thesis"])  # the first that was run
    assert set(primary(comparisons.comparisons_of(alone))["estimator"]) == {"inliers"}
    against = table[
        table["decides"] & table["reference"].isin(comparisons.SEGMENTATION_FREE_CONTROLS)
    ]
    words = against.set_index(["reference", "metric"])["verdict"]
    assert set(words["mirrored"]) == {"lower"} and set(words["fewer"]) == {"higher"}
    assert comparisons.verdict_of(table[:0]) == "too few sequences to tell"


def test_a_sequence_may_have_the_name_of_a_column():
    runs = runs_of({"masked": 0.5}).replace({"sequence": {"03": "ratio"}})
    row = primary(comparisons.comparisons_of(runs)).iloc[0]
    assert row["n"] == 8 and row["ratios"]["ratio"] == pytest.approx(0.5)
    table = comparison.long_table_of_ratios(comparisons.comparisons_of(runs)).content
    assert list(table.columns[-8:]) == sorted(runs["sequence"].unique())


def test_sources_are_compared_with_each_other():
    one, other = runs_of({"masked": 0.5}), runs_of({"masked": 0.25})
    other = other[other["method"] == "masked"].assign(source="other")
    runs = pd.concat([one, other])
    assert comparisons.sources(runs) == ["net", "other"]
    assert set(comparisons.of_source(runs, "other")["method"]) == {"baseline", "masked"}
    table = comparisons.comparisons_of(runs)
    row = table[(table["source"] == "net") & (table["reference_source"] == "other")].iloc[0]
    assert row["ratio"] == pytest.approx(2)


def test_the_tested_width_is_the_width_of_the_controls():
    narrow = runs_of({"masked": 0.5, "mirrored": 1.0}, width=5)
    assert comparisons.tested_width(narrow) == 5
    assert comparisons.tested_width(runs_of({"masked": 0.5}, width=7)) == 7  # the only width
    assert comparisons.tested_width(runs_of({})) == 10
    # ready-made masks
    assert comparisons.tested_width(runs_of({"masked": 0.5}).assign(dilation_width=np.nan)) is None
    assert (comparisons.keypoints_left(narrow, "") == 505).all()
    assert comparisons.tested_width(pd.concat([narrow, runs_of({"mirrored": 1.0}, width=7)])) == 10


def parts_of(
    error, sequences=(*EIGHT, "08", "09", "10"), widths=range(1, 16), repetitions=5, noise=0.0
):
    """(masked, baseline) runs with errors error(sequence, width).

    The width is None for all keypoints.
    """
    runs = made_up.runs(
        sequences,
        lambda name, _, width: error(name, width),
        {"baseline": [None], "masked": widths},
        estimators=["thesis"],
        repetitions=repetitions,
        noise=noise,
    )
    return runs[runs["method"] == "masked"], runs[runs["method"] == "baseline"]


def separate_optimum(name, width):
    """Error of a run when every sequence has another best width."""
    if width is None:
        return 1.0
    if width == 1 + int(name):
        return 0.5
    return 1.2 + 0.01 * width


def test_leaving_one_out_shows_that_the_best_width_is_chance():
    masked, baseline = parts_of(separate_optimum)
    chosen = tables.chosen_widths(masked, baseline)
    assert chosen["best"].tolist() == list(range(1, 12)) and chosen["fixed"].nunique() == 1
    for choice, better in (("best", 11), ("fixed", 1), ("left_out", 0)):
        rows = tables.of_chosen_width(masked, chosen[choice])
        changes = tables.changes(rows, baseline, "rmse")
        assert (changes < 0).sum() == better


def test_other_repetitions_confirm_a_real_optimum_and_no_chance():
    real = tables.stability(*parts_of(separate_optimum, noise=0.05))
    assert (real["same_best"] == 100).all()
    assert np.allclose(real["elsewhere"], 0.5, atol=0.06)
    chance = tables.stability(*parts_of(lambda *_: 1.0, noise=0.2))
    assert chance["same_best"].mean() < 20
    assert chance["elsewhere"].mean() == pytest.approx(1, abs=0.1)
    assert tables.stability(*parts_of(separate_optimum, repetitions=1)).isna().all(axis=None)
    masked, baseline = parts_of(separate_optimum)  # only one width has repetitions
    repeated = masked[(masked["repetition"] == 0) | (masked["dilation_width"] == 10)]
    assert tables.stability(repeated, baseline).isna().all(axis=None)


def test_two_widths_are_enough_to_tell_whether_the_best_is_stable():
    errors = {5: (1, 3, 2), 10: (2, 1, 4)}  # best: 5, 10, 5
    rows = [("00", n, width, error) for width in errors for n, error in enumerate(errors[width])]
    masked = pd.DataFrame(rows, columns=["sequence", "repetition", "dilation_width", "rmse"])
    found = tables.stability(masked, masked.assign(rmse=2.0)).loc["00"]
    assert found["same_best"] == pytest.approx(100 / 3)  # one pair of three
    assert found["elsewhere"] == pytest.approx((5 / 2 + 6 / 2 + 4 / 2) / 3 / 2)


def test_the_best_of_many_widths_looks_better_if_masks_do_nothing():
    _, baseline = parts_of(lambda *_: 1.0, repetitions=400, noise=0.2)
    studies = tables.null_distribution(baseline, 15, "rmse")
    assert studies.shape == (tables.STUDIES, 11)
    # a standard normal's least of 15 is -1.736 on average, its median 0
    expected = 100 * (np.exp(-1.736 * 0.2) - 1)
    assert studies.median(axis=1).mean() == pytest.approx(expected, abs=2.5)
    single = tables.null_distribution(baseline, 1, "rmse")
    assert single.median(axis=1).mean() == pytest.approx(0, abs=2)
    # the width is chosen by the RMSE, and another error judges it
    other = baseline.assign(mae=1 / baseline["rmse"])
    assert (tables.null_distribution(other, 15, "mae").mean() > 0).all()
    once = baseline[baseline["repetition"] == 0]
    assert tables.null_distribution(once, 15, "rmse").empty
