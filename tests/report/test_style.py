"""Axes that figures share."""

import matplotlib.pyplot as plt
import numpy as np
import pytest

from thesis_repro.report import style


@pytest.mark.parametrize("low, high", [(1, 1), (1.01, 1.02), (0.97, 1.3), (0.3, 4), (2, 90), (1, 130), (1e-3, 1e5),
                                       (300, 2000), (1.5, 0.7), (np.nan, 1.2), (0, np.inf)])
def test_a_ratio_axis_has_a_few_round_ticks_within_it(low, high):
    axis = plt.figure().add_subplot().yaxis
    style.ratio_axis(axis, [low, high])
    bottom, top = axis.get_view_interval()
    ticks = [tick for tick in axis.get_ticklocs() if bottom <= tick <= top]
    assert axis.get_scale() == "log" and 2 <= len(ticks) <= 8
    assert all(bottom <= value <= top for value in (low, high) if 0 < value < np.inf)
    assert not len(axis.get_ticklocs(minor=True))
    assert all(float(axis.get_major_formatter()(tick)) == pytest.approx(tick, rel=1e-5) for tick in ticks)
