"""What the thesis's procedure reports of masks that do nothing."""

import numpy as np
import pandas as pd
import pytest

from thesis_repro.study import chance


def errors(spread, orders=200):
    random = np.random.default_rng(0)
    return pd.DataFrame([{"sequence": f"{name:02d}", "rmse": (name + 1) * np.exp(random.normal(0, spread)),
                          "frames": 30, "metres": 20.0, "repetition": order}
                         for name in range(4) for order in range(orders)])


def test_without_spread_nothing_is_reported():
    found = chance.nothing(errors(0), draws=200)
    assert np.abs(found.to_numpy()).max() < 1e-9


def test_the_best_of_many_gains_what_order_statistics_say():
    spread = 0.2
    found = chance.nothing(errors(spread, 2000), draws=3000)
    # a standard normal's least of 15 is -1.736 on average, its median 0
    assert found.loc["median", "expected"] == pytest.approx(100 * (np.exp(-1.736 * spread) - 1), abs=2.5)
    assert found.loc["mean", "low"] < found.loc["mean", "expected"] < found.loc["mean", "high"] < 0
    assert chance.nothing(errors(spread), widths=1, draws=3000).loc["median", "expected"] == pytest.approx(0, abs=1.5)


def test_the_level_of_a_sequences_error_does_not_count():
    own = errors(0.3)
    other = own.assign(rmse=own["rmse"] * own["sequence"].astype(int).add(1) * 7)
    assert np.allclose(chance.deviations(own), chance.deviations(other))


def test_how_often_a_reported_number_would_come_about():
    few, many = (chance.share_as_low(errors(0.3), *reported) for reported in ((-90, -90), (50, 50)))
    assert few == (0, 0) and many == (1, 1)


def test_longer_stretches_stand_in_order():
    short, long = errors(0.1), errors(0.4).assign(frames=60, metres=40.0)
    table = chance.by_length(pd.concat([long, short]), draws=300)
    assert table["frames"].tolist() == [30, 60] and table["spread"].iloc[0] < table["spread"].iloc[1]
    assert table["mean"].iloc[1] < table["mean"].iloc[0] < 0
