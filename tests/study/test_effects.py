"""Switches one by one, where keypoints lie, and what Canny does to boundaries."""

import numpy as np
from street import Street, Stripes

from thesis_repro import masks
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import THESIS, keypoints
from thesis_repro.study import effects


def test_boundaries_of_ids_close_together_are_lost_and_far_apart_found():
    label_map = np.full((320, 320), 7, np.uint8)
    label_map[:, 160:] = 8
    near = effects.boundaries(label_map, (188, 620))
    label_map[:, 160:] = 23
    far = effects.boundaries(label_map, (188, 620))
    assert near["lost"] == 100 == near["road/sidewalk"] and far["lost"] == 0
    assert np.isnan(far["road/sidewalk"])


def test_bilinear_ids_of_no_class_nearby_are_counted():
    label_map = np.zeros((20, 20), np.uint8)
    label_map[:, 10:] = 20
    wide = effects.boundaries(label_map, (200, 400))
    label_map[:] = 20
    assert wide["invented"] > 1 and effects.boundaries(label_map, (200, 400))["invented"] == 0


def test_points_in_fewer_places_tell_less_of_the_heading():
    street = Street(3)
    street.size = street.images[0].shape
    corner = np.zeros(street.size, np.uint8)
    corner[60:100, 380:440] = 255
    table = effects.tracks(street, {"all keypoints": None, "stripes": Stripes(40), "corner": [corner] * 3}, pairs=2)
    means = table.groupby("keypoints of")[["cells", "heading", "keypoints"]].mean()
    assert means.loc["all keypoints", "cells"] > means.loc["corner", "cells"]
    assert means.loc["corner", "heading"] > 3 * means.loc["all keypoints", "heading"]
    assert (table["residual"] < 1).all()


def test_keypoints_by_lot_are_keypoints_and_as_many_as_asked_for(small_world):
    sequence = Sequence(small_world / "kitti", "00").subset(2)
    some = effects.AnyKeypoints(sequence, 300)
    found = keypoints.detect(sequence.frame(0), THESIS, some[0])
    every = {tuple(point) for point in keypoints.detect(sequence.frame(0), THESIS).astype(int)}
    assert 280 <= len(found) <= 300 and {tuple(point) for point in found.astype(int)} <= every
    assert np.array_equal(some[0], effects.AnyKeypoints(sequence, 300)[0])


def test_every_switch_differs_from_its_reference_in_one_thing(small_world, small_labels):
    sequence = Sequence(small_world / "kitti", "00").subset(4)
    runs = effects.runs_of(sequence, small_labels / "00", effects.Plan(orders=2, chance=3))
    settings, own = runs["masks", "thesis", 0]
    assert settings == THESIS and np.array_equal(own[0], masks.LabelMasks(small_labels / "00", sequence, 10)[0])
    dropped, same = runs["filter", "thesis", 0]
    assert dropped.mask_mode == "filter" and same is own
    assert {order for method, estimator, order in runs if (method, estimator) == ("all", "thesis")} == {0, 1, 2}
    assert {order for method, estimator, order in runs if (method, estimator) == ("all", "refined")} == {0, 1}
    for method in ("nearest", "symmetric"):
        other = runs[method, "thesis", 0][1][0]
        assert not np.array_equal(other, own[0]) and 0.5 < (other > 0).sum() / (own[0] > 0).sum() < 2


def test_runs_are_kept_and_not_made_again(small_world, small_labels, tmp_path, monkeypatch):
    plan = effects.Plan(orders=1, chance=2, frames=5)
    arguments = (small_world / "kitti", ["00"], small_labels, tmp_path, plan)
    runs, prefixes = effects.measure(*arguments)
    assert set(runs["sequence"]) == {"00"} and runs["rmse"].notna().all() and set(prefixes["repetition"]) == {0, 1}
    monkeypatch.setattr(effects.odometry, "run_many", None)  # would fail
    assert effects.measure(*arguments)[0].equals(runs)
