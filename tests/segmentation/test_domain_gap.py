"""Errors in shadow and flicker, on pictures whose result is known."""

import cv2
import numpy as np
import pytest

from thesis_repro import cityscapes, kitti
from thesis_repro.segmentation import domain_gap
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow

ROAD, BUILDING, SKY, CAR = 7, 11, 23, 26


def halves(column):
    """Return a label map with sky to the left of a column and road to the right."""
    label_map = np.full((1, 320, 320), SKY, np.uint8)
    label_map[:, :, column:] = ROAD
    return label_map


def test_errors_in_shadow_are_told_from_errors_in_light():
    images, true = np.full((2, 100, 100, 1), 100, np.uint8), np.full((2, 100, 100), ROAD, np.uint8)
    images[:, :20] = 50  # a fifth in shadow
    predicted = true.copy()
    predicted[0, :10] = CAR  # half of it wrong in the first image
    predicted[:, 90:] = SKY  # and an eighth of the light in both
    expected = {"dark": 0.2, "dark_wrong": 0.25, "lit_wrong": 1 / 8}
    assert domain_gap.shadow_errors(images, true, predicted) == pytest.approx(expected)


def test_dark_is_relative_to_the_class_and_only_ground_counts():
    images, true = np.full((1, 100, 100, 1), 100, np.uint8), np.full((1, 100, 100), ROAD, np.uint8)
    true[:, :, 50:] = CAR
    images[:, :, 50:] = 10  # a black car does not make the road dark
    errors = domain_gap.shadow_errors(images, true, np.full_like(true, SKY))
    assert errors["dark"] == 0 and errors["lit_wrong"] == 1 and np.isnan(errors["dark_wrong"])
    images[:, :, :50] = 61  # equally dark everywhere, so no pixel counts as dark
    assert domain_gap.shadow_errors(images, true, true)["dark"] == 0


def test_pixels_near_a_boundary_are_ignored():
    images, true = np.full((1, 320, 320, 1), 100, np.uint8), halves(160)
    assert domain_gap.shadow_errors(images, true, halves(164))["lit_wrong"] == 0
    assert domain_gap.shadow_errors(images, true, halves(168))["lit_wrong"] > 0


def test_flicker_of_a_moving_picture_with_and_without_noise():
    texture = cv2.GaussianBlur(
        np.random.default_rng(0).integers(0, 256, (160, 300), np.uint8), (0, 0), 2
    )
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX)
    patches = np.random.default_rng(1).choice([ROAD, BUILDING, SKY], (4, 8))
    classes = np.kron(patches, np.ones((40, 40))).astype(np.uint8)
    frames = [texture[:, shift : shift + 240] for shift in (0, 3, 6)]
    true = [classes[:, shift : shift + 240] for shift in (0, 3, 6)]
    wrong = [label_map.copy() for label_map in true]
    # a fifth of one frame flips
    wrong[1][np.random.default_rng(2).random(wrong[1].shape) < 0.2] = CAR

    steady = domain_gap.flicker(true, frames)
    assert len(steady) == 2 and (steady < 0.01).all()
    assert domain_gap.flicker(wrong, frames).tolist() == pytest.approx([0.2, 0.2], abs=0.02)
    # without compensation of the motion, the boundaries alone would change more
    assert (true[1] != true[0]).mean() > 3 * steady.max()


def test_models_are_measured_on_each_domain_and_drive(small_world):
    model = build_unet((32, 32, 1), cityscapes.N_CLASSES, 2)
    drives = [kitti.Sequence(small_world / "kitti", name).subset(3) for name in ("00", "01")]
    frames = domain_gap.labelled_frames(drives)
    assert len(set(frames)) == 6
    domains = {"streets": cityscapes.pairs(small_world / "cityscapes", "val"), "frames": frames}
    gap = domain_gap.measure({"tiny": model}, domains, drives[:1])
    assert gap.scores["domain"].tolist() == ["streets", "frames"]
    assert gap.scores["images"].tolist() == [len(pairs) for pairs in domains.values()]
    present = gap.classes.groupby("domain", sort=False)
    assert gap.scores["classes"].tolist() == present.size().tolist()
    assert gap.scores["mean_iou"].tolist() == pytest.approx(present["iou"].mean().tolist())
    assert present["share"].sum().tolist() == pytest.approx([1, 1])
    assert set(gap.flicker.index) == {"tiny", domain_gap.EXACT} and gap.flicker.between(0, 1).all()
