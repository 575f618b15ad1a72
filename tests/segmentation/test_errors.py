"""Where label maps are wrong: on pictures whose answer is known."""

import numpy as np
import pytest

from thesis_repro.segmentation import errors

ROAD, SKY, CAR, EGO = 7, 23, 26, 1


def halves(column, size=320):
    """Sky to the left of a column, road to the right."""
    label_map = np.full((1, size, size), SKY, np.uint8)
    label_map[:, :, column:] = ROAD
    return label_map


@pytest.mark.parametrize("column, found", [(100, 1), (102, 1), (103, 0), (98, 1), (97, 0)])
def test_a_boundary_is_found_within_two_pixels(column, found):
    scores = errors.boundary_scores(halves(100), halves(column))
    assert scores["found"] == scores["right"] == found
    assert scores["chance"] == pytest.approx(5 / 320)  # the band around the predicted line


def test_boundaries_of_no_evaluated_class_do_not_count():
    true, predicted = halves(100), halves(100)
    true[:, 200:] = EGO  # the own car, which no benchmark asks for
    predicted[:, 250:, 50:] = CAR
    assert errors.boundary_scores(true, predicted) == pytest.approx({"found": 1, "right": 1, "chance": 5 / 320})
    nothing = errors.boundary_scores(np.full_like(true, EGO), predicted)
    assert nothing == {"found": 0, "right": 0, "chance": 0}


def test_label_maps_of_any_size_are_compared_at_320():
    assert errors.boundary_scores(halves(50, 160), halves(51, 160))["found"] == 1
    assert errors.boundary_scores(halves(50, 160), halves(52, 160))["found"] == 0


def test_errors_in_shadow_are_told_from_errors_in_light():
    images, true = np.full((2, 100, 100, 1), 100, np.uint8), np.full((2, 100, 100), ROAD, np.uint8)
    images[:, :20] = 50  # a fifth in shadow
    predicted = true.copy()
    predicted[0, :10] = CAR  # half of it wrong in the first image
    predicted[:, 90:] = SKY  # and an eighth of the light in both
    found = errors.shadow_errors(images, true, predicted)
    assert found["dark"] == pytest.approx(0.2) and found["taken_for"] == "car"
    assert found["dark_wrong"] == pytest.approx(0.25) and found["lit_wrong"] == pytest.approx(1 / 8)
    assert (found["worse"], found["compared"]) == (1, 2)


def test_dark_is_relative_to_the_class_and_other_things_do_not_count():
    images, true = np.full((1, 100, 100, 1), 100, np.uint8), np.full((1, 100, 100), ROAD, np.uint8)
    true[:, :, 50:] = CAR
    images[:, :, 50:] = 10  # a black car casts no doubt on the road
    found = errors.shadow_errors(images, true, np.full_like(true, SKY))
    assert found["dark"] == 0 and found["lit_wrong"] == 1 and np.isnan(found["dark_wrong"])
    assert found["compared"] == 0 and found["taken_for"] is None
    images[:, :, :50] = 61  # all of it dark, so nothing is
    assert errors.shadow_errors(images, true, true)["dark"] == 0


def test_what_lies_near_a_boundary_is_left_out_of_shadows():
    images, true = np.full((1, 320, 320, 1), 100, np.uint8), halves(160)
    predicted = halves(160 + errors.AWAY)  # road lost along the boundary alone
    assert errors.shadow_errors(images, true, predicted)["lit_wrong"] == 0
    assert errors.shadow_errors(images, true, halves(160 + 2 * errors.AWAY))["lit_wrong"] > 0
