"""Equation 4.1 and the choice of the dilation width."""

import made_up
import numpy as np
import pandas as pd
import pytest

from thesis_repro.study import thesis_tables

ELEVEN = [f"{number:02d}" for number in range(11)]


def parts_of(error, sequences=ELEVEN, widths=range(1, 16), repetitions=5, noise=0.0):
    """(masked, baseline) runs with errors error(sequence, width); width is None for all
    keypoints.
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
    return 1.0 if width is None else 0.5 if width == 1 + int(name) else 1.2 + 0.01 * width


def test_leaving_one_out_shows_that_the_best_width_is_chance():
    masked, baseline = parts_of(separate_optimum)
    chosen = thesis_tables.chosen_widths(masked, baseline)
    assert chosen["best"].tolist() == list(range(1, 12)) and chosen["fixed"].nunique() == 1
    for choice, better in (("best", 11), ("fixed", 1), ("left_out", 0)):
        changes = thesis_tables.changes(
            thesis_tables.of_chosen_width(masked, chosen[choice]), baseline, "rmse"
        )
        assert (changes < 0).sum() == better


def test_leaving_one_out_ignores_the_errors_of_that_sequence():
    masked, baseline = parts_of(separate_optimum, noise=0.3)
    chosen = thesis_tables.chosen_widths(masked, baseline)["left_out"]
    changed, left_out = masked.copy(), masked["sequence"] == "04"
    changed.loc[left_out, "rmse"] = np.random.default_rng(5).uniform(0.01, 50, left_out.sum())
    assert thesis_tables.chosen_widths(changed, baseline)["left_out"]["04"] == chosen["04"]
    without = thesis_tables.chosen_widths(masked[~left_out], baseline[baseline["sequence"] != "04"])
    assert without["fixed"].iloc[0] == chosen["04"]


def test_a_width_that_failed_in_one_sequence_is_not_chosen_for_all():
    masked, baseline = parts_of(
        lambda name, width: 0.1 if width == 15 else 1.0, ["00", "01", "02"], (5, 10, 15)
    )
    failed = (masked["sequence"] == "01") & (masked["dilation_width"] == 15)
    chosen = thesis_tables.chosen_widths(masked[~failed], baseline)
    assert set(chosen["fixed"]) == {5} and chosen["left_out"].tolist() == [5, 15, 5]


def test_other_repetitions_confirm_a_real_optimum_and_no_chance():
    real = thesis_tables.stability(*parts_of(separate_optimum, noise=0.05))
    assert (real["same_best"] == 100).all() and np.allclose(real["elsewhere"], 0.5, atol=0.06)
    chance = thesis_tables.stability(*parts_of(lambda *_: 1.0, noise=0.2))
    assert chance["same_best"].mean() < 20 and chance["elsewhere"].mean() == pytest.approx(
        1, abs=0.1
    )
    assert thesis_tables.stability(*parts_of(separate_optimum, repetitions=1)).isna().all(axis=None)
    masked, baseline = parts_of(separate_optimum)  # only one width has repetitions
    repeated = masked[(masked["repetition"] == 0) | (masked["dilation_width"] == 10)]
    assert thesis_tables.stability(repeated, baseline).isna().all(axis=None)


def test_time_savings_are_negative_percentages_over_all_sequences():
    seconds = pd.DataFrame(
        {
            "sequence": ["00", "00", "01", "01"],
            "method": ["baseline", "masked"] * 2,
            "dilation_width": [np.nan, 5] * 2,
            "seconds": [10.0, 4.0, 30.0, 26.0],
        }
    )
    assert thesis_tables.time_savings(seconds).to_dict() == {5: -25}
