"""Figures are drawn without a window in the package's style, and closed after each test."""

import matplotlib
import matplotlib.pyplot as plt
import pytest

from keypoint_study.report import style

matplotlib.use("Agg")


@pytest.fixture(autouse=True)
def drawing():
    with style.applied():
        yield
    plt.close("all")
