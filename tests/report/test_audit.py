"""The audit's rows, and what they are joined with."""

import json

import pytest

from thesis_repro.report import audit, captions


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
