from dataclasses import replace

import cv2
import numpy as np
import pytest

from thesis_repro import masks, odometry
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import keypoints
from thesis_repro.study import compare, controls, runner, thesis_tables
from thesis_repro.study.jobs import first_jobs, keypoint_control_jobs, reduced_jobs
from thesis_repro.study.sources import Source

WIDTH = 10


@pytest.fixture(scope="module")
def sequence(small_world):
    return Sequence(small_world / "kitti", "00")


@pytest.fixture(scope="module")
def made(sequence, small_labels):
    """Masks of every control and of the thesis, by method."""
    return {
        method: controls.masks(method, Source(small_labels), sequence, WIDTH)
        for method in controls.MASK_CONTROLS
    } | {"masked": masks.LabelMasks(small_labels / "00", sequence, WIDTH)}


def test_masks_of_controls_are_valid_and_repeatable(sequence, made):
    for method, source in made.items():
        assert len(source) == len(sequence)
        mask = source[3]
        assert (
            mask.shape == sequence.size
            and mask.dtype == np.uint8
            and set(np.unique(mask)) == {0, 255}
        ), method
        assert mask.flags.c_contiguous
        source[7]
        assert np.array_equal(source[3], mask), method
        assert np.array_equal(mask, made["masked"][3]) == (method in ("masked", "fallback")), method


def test_controls_use_the_frame_and_settings_of_their_name(
    sequence, small_world, small_labels, made
):
    for index, other in ((0, 6), (5, 11), (6, 0), (11, 5)):
        assert np.array_equal(made["other-frame"][index], made["masked"][other])
        assert np.array_equal(made["mirrored"][index], cv2.flip(made["masked"][index], 1))
    predicted = cv2.imread(str(small_labels / "00" / "000005.png"), cv2.IMREAD_GRAYSCALE)
    true = cv2.imread(
        str(small_world / "kitti/sequences/00/labels_0/000005.png"), cv2.IMREAD_GRAYSCALE
    )
    for method, label_map, settings in (
        ("true-labels", true, masks.MaskSettings()),
        ("exact-boundaries", predicted, masks.MaskSettings("exact")),
        ("corrected", predicted, masks.MaskSettings("exact", symmetric=True, movable=2, margin=10)),
    ):
        assert np.array_equal(
            made[method][5], masks.keypoint_mask(label_map, sequence.size, WIDTH, settings)
        ), method


def test_random_lines_and_image_edges_cover_as_much_as_the_mask(sequence, made):
    for index in range(12):
        expected = masks.coverage(made["masked"][index])
        assert 0.05 < expected < 0.95
        assert masks.coverage(made["random-lines"][index]) == pytest.approx(expected, abs=0.01)
        assert masks.coverage(made["image-edges"][index]) == pytest.approx(expected, abs=0.01)
    assert not np.array_equal(made["random-lines"][0], made["random-lines"][1])
    # segments are dilated like boundaries, so opening changes only the border
    mask = made["random-lines"][2]
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((WIDTH - 1, WIDTH - 1), np.uint8))
    assert np.array_equal(opened[WIDTH:-WIDTH, WIDTH:-WIDTH], mask[WIDTH:-WIDTH, WIDTH:-WIDTH])
    dx, dy = cv2.spatialGradient(sequence.frame(3))
    strength = np.abs(dx.astype(int)) + np.abs(dy)
    strongest = strength >= np.quantile(strength, 0.995)
    assert (made["image-edges"][3][strongest] > 0).mean() > 0.9
    assert (made["random-lines"][3][strongest] > 0).mean() < 0.6


@pytest.mark.parametrize("value", [0, 255])
def test_controls_of_empty_and_full_masks(sequence, made, monkeypatch, value):
    monkeypatch.setattr(
        masks.LabelMasks, "__getitem__", lambda self, index: np.full(self.size, value, np.uint8)
    )
    lines, edges = (masks.coverage(made[method][0]) for method in ("random-lines", "image-edges"))
    assert lines > 0.99 and edges > 0.5 if value else lines == edges == 0


def test_spread_keypoints_have_the_asked_number(sequence):
    counts = [len(keypoints.detect(frame, odometry.THESIS)) for frame in sequence.frames()]
    target = np.mean(counts) / 2
    distance = controls.min_distance(sequence, target)
    assert distance > odometry.THESIS.min_distance and distance == round(distance, 1)
    spread = replace(odometry.THESIS, min_distance=distance)
    left = np.mean([len(keypoints.detect(frame, spread)) for frame in sequence.frames()])
    assert left == pytest.approx(target, rel=0.03)
    assert controls.min_distance(sequence, max(counts)) == odometry.THESIS.min_distance


def test_controls_leave_as_many_keypoints_as_masks_of_the_tested_width(
    small_world, small_labels, tmp_path
):
    opened = [Sequence(small_world / "kitti", "00").subset(5)]
    jobs = first_jobs(opened, {"thesis": (5, WIDTH), "refined": ()}, tested=5)
    assert {job.dilation_width for job in jobs if job.method in controls.MASK_CONTROLS} == {5}
    runs = runner.run(jobs, opened, small_labels, tmp_path)
    left = compare.keypoints_left(runs)
    masked = compare.of_method(runs, "masked")
    jobs += reduced_jobs(thesis_tables.best_widths(masked)) + keypoint_control_jobs(
        left, opened, width=5
    )
    assert len({job.name for job in jobs}) == len(jobs)
    runs = runner.run(jobs, opened, small_labels, tmp_path).set_index("run")
    assert list(runs.index) == [job.name for job in jobs] and compare.tested_width(runs) == 5
    number = runs["mean_keypoints"]
    assert left["00"] == number["masked-05-0"] < number["masked-10-0"]
    assert number[number.index.str.startswith("fewer")].iloc[0] == pytest.approx(left["00"], abs=1)
    assert number[number.index.str.startswith("spread")].iloc[0] == pytest.approx(
        left["00"], rel=0.05
    )
