from inspect import signature

import pytest

from thesis import REPORTED
from thesis.diagrams import summary_rows
from thesis_repro import build_unet as public
from thesis_repro.errors import InputError
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow  # they load TensorFlow
FIGURE = REPORTED["figure_a1_model_summary"]


def test_every_row_of_figure_a1():
    model = build_unet((320, 320, 1), 35)

    assert summary_rows(model) == FIGURE["rows"]
    assert len(FIGURE["rows"]) == 41
    assert model.name == "U-Net"
    assert model.count_params() == FIGURE["total"] == 15_337_571
    assert sum(w.numpy().size for w in model.trainable_weights) == FIGURE["trainable"]
    assert sum(w.numpy().size for w in model.non_trainable_weights) == FIGURE["non_trainable"]


def test_corrected_blocks_and_base_filters():
    rows = {
        row["layer"].split()[0]: row
        for row in summary_rows(build_unet((64, 64, 3), 5, 8, corrected_blocks=True))
    }

    assert len(rows) == 41 + 3 * 9
    for layer, column, text in (
        ("conv2d", "connected_to", "input_2[0][0]"),
        ("conv2d_1", "connected_to", "activation[0][0]"),
        ("conv2d_17", "connected_to", "activation_16[0][0]"),
        ("conv2d_9", "output_shape", "(None, 4, 4, 128)"),
        ("conv2d_18", "output_shape", "(None, 64, 64, 5)"),
    ):
        assert rows[layer][column] == text


def test_the_public_name_has_the_same_arguments():
    ours, shown = (signature(each).parameters for each in (build_unet, public))
    assert [str(each) for each in shown.values()] == [str(each) for each in ours.values()]
    assert public((32, 32, 1), 3, 2, True).count_params() == (
        build_unet((32, 32, 1), 3, 2, True).count_params()
    )


def test_a_size_that_cannot_be_halved_four_times():
    with pytest.raises(InputError, match="100x100.*multiples of 16"):
        build_unet((100, 100, 1), 35)
