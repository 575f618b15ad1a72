"""Section 5.2's networks against each other: the colours, the page, and that each has its time."""

import numpy as np
import pandas as pd
import pytest

from thesis_repro.bench import proposals
from thesis_repro.settings import PROFILES

random = np.random.default_rng(0)


def data(colour):
    images = random.integers(0, 256, (6, 64, 64, 3 if colour else 1), np.uint8)
    labels = random.choice(np.array([7, 11, 23], np.uint8), (6, 64, 64))
    return proposals.Data(np.broadcast_to(images, (6, 64, 64, 3)), labels, np.broadcast_to(images, (6, 64, 64, 3))[:2],
                          labels[:2], "noise")


def test_colours_leave_the_luminance_and_differ():
    tints = proposals._tints({"lane": 0, "leaves": 1, "sign0": 2, "sign1": 3, "facade7": 4, "truck2": 5})
    assert tints @ proposals.LUMINANCE == pytest.approx(1)
    assert tints[0] == pytest.approx(1) and tints[1].argmax() == 1 and tints[2].argmax() == 2 and tints[3].argmax() == 0


def test_the_page_has_mean_and_range_over_the_seeds():
    table = pd.DataFrame([{"network": name, "seed": seed, "mean_iou": iou, "accuracy": 0.5, "milliseconds": 20.0,
                           "parameters": 1234, "seen": 100}
                          for name, seed, iou in (("one", 0, 0.1), ("one", 1, 0.3), ("other", 0, 0.2))])
    text = proposals.page(data(colour=False), table, 60)
    assert "| one | 0.200 (0.100 to 0.300) | 0.500 (0.500 to 0.500) | 20 | 1,234 | 100 |" in text
    assert text.startswith("**Noise.** These images are gray, so colour is left out.") and "seeds 0, 1" in text
    assert "gray, so" not in proposals.page(data(colour=True), table, 60)


@pytest.mark.slow
def test_all_networks_are_trained_and_measured(monkeypatch):
    monkeypatch.setattr(proposals, "SIZES", PROFILES["smoke"])
    table = proposals.compare(data(colour=True), seconds=0.5, seeds=(0,))
    assert table["network"].tolist() == ["the thesis's network", "in colour", "backbone resnet18", "ensemble of 2"]
    assert (table["seen"] >= PROFILES["smoke"].batch_size).all() and table["accuracy"].between(0, 1).all()
    parameters = table.set_index("network")["parameters"]
    assert parameters["in colour"] - parameters["the thesis's network"] == 9 * 2 * PROFILES["smoke"].base_filters
    assert parameters["ensemble of 2"] == 2 * parameters["the thesis's network"]


def test_colour_is_left_out_where_the_images_have_none(monkeypatch):
    monkeypatch.setattr(proposals, "train", lambda build, images, labels, seconds, seed: ((images.shape, seconds), 1))
    monkeypatch.setattr(proposals.backbones, "ensemble", len)
    monkeypatch.setattr(proposals.backbones, "backbone_unet", lambda name: name)
    found = {name: model for name, model, *_ in proposals.methods(data(colour=False), 60, 0)}
    assert found == {"the thesis's network": ((6, 64, 64, 1), 60), "backbone resnet18": ((6, 64, 64, 1), 60),
                     "ensemble of 2": 2}
    assert "in colour" in {name for name, *_ in proposals.methods(data(colour=True), 60, 0)}
