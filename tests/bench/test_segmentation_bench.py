"""The bench of the segmentation: its ratios are those of the speeds it prints."""

import subprocess
import sys

import pytest

from thesis_repro import cityscapes
from thesis_repro.bench import segmentation as bench_segmentation
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow


def test_the_input_is_set_against_the_training():
    found = bench_segmentation.input_speed(32, 2, 4, images=8, repeats=1)
    assert found["times_faster"] == pytest.approx(found["made_images_per_s"] / found["consumed_images_per_s"])
    assert found["made_images_per_s"] > 0 < found["consumed_images_per_s"]


def test_prediction_is_set_against_the_thesis_s():
    model = build_unet((32, 32, 1), cityscapes.N_CLASSES, 2)
    found = bench_segmentation.prediction_speed(model, frames=8, one_by_one=3, batch_size=4, frame_size=(40, 80))
    assert found["times_faster"] == pytest.approx(found["sequence_frames_per_s"] / found["one_by_one_frames_per_s"])
    assert found["times_faster"] > 1 and found["parameters"] == model.count_params()


def test_the_input_side_holds_bytes_not_floats():
    # in a process of its own, for memory that earlier tests freed would be taken again
    program = ("from thesis_repro.bench import segmentation as bench\n"
               "print(bench.input_memory(64, batches=2)['gigabytes'])")
    gigabytes = float(subprocess.run([sys.executable, "-c", program], capture_output=True, text=True,
                                     check=True).stdout.split()[-1])
    # two bytes a pixel, an image and its label map, and some batches
    assert 0.9 * 2 * 5950 * 64**2 / 1e9 < gigabytes < 4 * 2 * 5950 * 64**2 / 1e9


def test_operations_are_those_of_the_convolutions_that_run():
    model = build_unet((32, 32, 1), 35, 2)

    def convolutions(side, inputs, filters):
        return side**2 * 9 * inputs * filters

    way_down = [convolutions(32, 1, 2), convolutions(16, 2, 4), convolutions(8, 4, 8), convolutions(4, 8, 16),
                convolutions(2, 16, 32)]
    up = [2 * 2 * 4 * 32 * 16, 4 * 4 * 4 * 16 * 8, 8 * 8 * 4 * 8 * 4, 16 * 16 * 4 * 4 * 2]
    way_up = [convolutions(4, 32, 16), convolutions(8, 16, 8), convolutions(16, 8, 4), convolutions(32, 4, 2)]
    assert bench_segmentation.operations(model) == 2 * (sum(way_down + up + way_up) + 32**2 * 2 * 35)


def test_the_share_of_the_peak_follows_from_the_times():
    model = build_unet((32, 32, 1), 35, 2)
    found = bench_segmentation.arithmetic(model, side=512, repeats=1)
    assert found["share_of_peak"] == pytest.approx(found["network_gflops"] / found["peak_gflops"])
    assert found["gflop_an_image"] == bench_segmentation.operations(model) / 1e9
    assert 0 < found["share_of_peak"] < 1
