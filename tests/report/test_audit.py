"""The audit's rows, what they are joined with, and the answer in words."""

import json
import re

import numpy as np
import pandas as pd
import pytest

from thesis_repro.report import audit, captions, comparison
from thesis_repro.study import answer
from thesis_repro.study.jobs import ESTIMATORS


def summary(sequences, errors, repetitions=3):
    """Runs with given errors: {method: factor on the error of all keypoints}."""
    random, rows = np.random.default_rng(0), []
    for name in sequences:
        for method, factor in errors.items():
            for estimator in ESTIMATORS:
                for repetition in range(repetitions):
                    error = factor * np.exp(random.normal(0, 0.02))
                    rows.append({"sequence": name, "method": method, "estimator": estimator, "repetition": repetition,
                                 "dilation_width": 10 if method not in ("baseline", "fewer", "spread") else np.nan,
                                 "max_keypoints": np.nan, "min_distance": np.nan, "mean_keypoints": 900 * factor,
                                 "rmse": error, "turned": error, "mae": error, "rotation": error / 10, "frames": 30,
                                 "se3": error / 2, "translation_percent": error, "rotation_deg_per_m": np.nan})
    return pd.DataFrame(rows)


def test_the_31_rows_of_the_audit_and_more_each_say_what_is_right():
    numbers = [int(row["row"]) for row in audit.ROWS]
    assert numbers == list(range(1, len(numbers) + 1)) and len(numbers) >= 31
    assert all(row[key].strip() for row in audit.ROWS for key in ("where", "does", "right", "switch"))


def test_arithmetic_is_that_of_the_thesiss_tables():
    said = " ".join(f"{one.row}: {one.effect} {one.spread}" for one in audit.arithmetic())
    assert "RMSE: sum -13.20, mean -1.20, median -5.27 %" in said
    assert "MAE: sum -25.65, mean -2.33, median 1.76 %" in said
    assert "3: 2.63 times fewer" in said and "1.98 to 4.12" in said
    assert "4: RMSE is larger in 03, 04, 05, 07, 09; MAE is larger in 00, 03, 04, 05, 06, 07, 09" in said
    assert "RMSE smaller in 6 of 11; lots would do as well in 50 of 100" in said
    assert "02: -101 frames" in said and "07: -1 frames" in said


def test_the_arithmetic_follows_the_numbers(monkeypatch):
    changed = json.loads(json.dumps(captions.REPORTED))
    changed["table_4_2_rmse_percent_change"]["05"] = -50.0
    monkeypatch.setattr(audit, "REPORTED", changed)
    assert "RMSE smaller in 7 of 11" in " ".join(one.effect for one in audit.arithmetic())


def test_a_row_without_a_measurement_says_so_and_an_unknown_row_is_refused():
    table = audit.table(audit.arithmetic(), "made up")
    assert {"5", "13"} <= set(audit.missing(table)) and "1" not in audit.missing(table)
    untried = table[table["switch"] == audit.UNTRIED]
    assert len(untried) and (untried["effect of the switch alone"] == audit.UNTRIED).all()
    with pytest.raises(ValueError, match="999"):
        audit.table([audit.Effect("999", "nothing")], "made up")


def test_several_effects_of_a_row_stand_together_with_their_spreads():
    table = audit.table([audit.Effect("13", "one", "a"), audit.Effect("13", "two", "b")], "made up").set_index("row")
    assert table.loc["13", "effect of the switch alone"] == "one; two" and table.loc["13", "spread"] == "a; b"
    assert table.loc["13", "data"] == "made up" and table.loc["1", "data"] == "the thesis's tables"


@pytest.mark.parametrize(("factors", "says"), [
    ({"masked": 0.5, "mirrored": 1.0, "fewer": 1.1}, "the segmentation matters"),
    ({"masked": 0.5, "mirrored": 0.4, "fewer": 1.1}, "not for what the segmentation knows"),
    ({"masked": 2.0, "mirrored": 1.0, "fewer": 1.1}, "Masks do worse than all keypoints here"),
    ({"masked": 1.0, "mirrored": 1.0, "fewer": 1.1}, "not shown to help"),
])
def test_the_answer_is_chosen_by_the_numbers(factors, says):
    runs = summary([f"{number:02d}" for number in range(8)], {"baseline": 1.0, **factors})
    if factors["masked"] == 1.0:  # an interval that holds 1
        odd = (runs["method"] == "masked") & (runs["sequence"].astype(int) % 2 == 0)
        runs.loc[odd, ["rmse", "turned", "rotation"]] *= 1.5
        runs.loc[(runs["method"] == "masked") & ~odd, ["rmse", "turned", "rotation"]] /= 1.5
    assert says in comparison.words(runs, "made up")


def test_few_sequences_say_nothing_in_general():
    text = comparison.words(summary(["00", "01", "02"], {"baseline": 1.0, "masked": 0.5, "fewer": 1.0}), "made up")
    assert "3 sequences say nothing of sequences in general" in text and "help here" not in text


def test_corrected_masks_and_other_errors_are_said_in_words_where_there_are_any():
    factors = {"baseline": 1.0, "masked": 0.5, "corrected": 0.25, "fewer": 1.0}
    runs = summary([f"{number:02d}" for number in range(8)], factors)
    runs.loc[runs["method"] == "masked", "se3"] *= 4
    text = comparison.words(runs, "made up")
    aligned, translation = re.search(r"beside them, aligned ATE (\S+) .*, translation over 20 m (\S+) ", text).groups()
    assert float(aligned) == pytest.approx(2, abs=0.05) and float(translation) == pytest.approx(0.5, abs=0.02)
    assert "rotation over" not in text
    assert "With all of the thesis's slips corrected: RMSE without the angle 0.25 [" in text
    assert "corrected" not in comparison.words(runs[runs["method"] != "corrected"], "made up")


def test_half_and_double_are_equally_far_from_one():
    runs = summary(["00", "01"], {"baseline": 1.0, "masked": 1.0})
    for name, factor in (("00", 0.5), ("01", 2.0)):
        runs.loc[(runs["method"] == "masked") & (runs["sequence"] == name), ["rmse", "turned", "rotation"]] *= factor
    row = answer.compared(runs, "rmse").set_index("method").loc["masked"]
    assert row["ratio"] == pytest.approx(1, abs=0.03) and row["percent"] == pytest.approx(25, abs=4)


def test_the_figures_draw_every_method_and_the_table_has_a_row_for_each():
    runs = summary(["00", "01", "02"], {"baseline": 1.0, "masked": 0.5, "spread": 0.9})
    figure = comparison.figure_answer(runs)
    assert len(figure.axes) == len(ESTIMATORS) * len(answer.METRICS)
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["all keypoints", "segmentation mask", "keypoints spread out"]
    assert len(comparison.table(runs)) == 3 * len(ESTIMATORS) * (len(answer.SHOWN) - 1)  # one error is none of these runs
    panels = [axes for axes in comparison.figure_by_sequence(runs, "rmse").axes if axes.axison]
    assert [axes.get_title() for axes in panels] == ["00", "01", "02"]

