"""Ablations, the null distribution of the thesis's procedure, tracks and boundaries."""

import cv2
import numpy as np
import pandas as pd
import pytest
from street import Street, Stripes

from thesis_repro import masks
from thesis_repro.kitti import Sequence
from thesis_repro.odometry import THESIS, keypoints
from thesis_repro.study import ablations


def test_every_ablation_differs_from_its_reference_in_one_thing(small_world, small_labels):
    sequence = Sequence(small_world / "kitti", "00").subset(4)
    runs = ablations.runs_of(sequence, small_labels / "00", repetitions=2, baseline_repetitions=3)
    settings, thesis_masks = runs["masked", "thesis", 0]
    assert settings == THESIS and np.array_equal(
        thesis_masks[0], masks.LabelMasks(small_labels / "00", sequence, 10)[0]
    )
    dropped, same = runs["filter", "thesis", 0]
    assert dropped.mask_mode == "filter" and same is thesis_masks
    repetitions = {
        estimator: {key[2] for key in runs if key[:2] == ("baseline", estimator)}
        for estimator in ("thesis", "refined")
    }
    assert repetitions == {"thesis": {0, 1, 2}, "refined": {0, 1}}
    for method in ("nearest", "symmetric"):
        mask = runs[method, "thesis", 0][1][0]
        assert (
            not np.array_equal(mask, thesis_masks[0])
            and 0.5 < mask.sum() / thesis_masks[0].sum() < 2
        )
    label_map = cv2.imread(str(small_labels / "00" / sequence.frame_paths[0].name), 0)
    vegetation = np.isin(
        cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST), (21, 22)
    )
    assert np.array_equal(runs["no-vegetation", "thesis", 0][1][0] == 0, vegetation)


@pytest.mark.parametrize("amount, low, high", [(300, 280, 300), (0.5, 0.48, 0.5)])
def test_random_keypoints_are_a_subset_of_the_asked_size(small_world, amount, low, high):
    sequence = Sequence(small_world / "kitti", "00").subset(2)
    drawn = ablations.random_keypoints(sequence, amount, 0)
    points = keypoints.detect(sequence.frame(0), THESIS, drawn)
    detected = {tuple(point) for point in keypoints.detect(sequence.frame(0), THESIS).astype(int)}
    count = len(points) if isinstance(amount, int) else len(points) / len(detected)
    assert low <= count <= high and {tuple(point) for point in points.astype(int)} <= detected
    assert np.array_equal(drawn, ablations.random_keypoints(sequence, amount, 0))


REPORTED = pd.Series([0.0] * 11)


def errors(spread, repetitions=200):
    random = np.random.default_rng(0)
    return pd.DataFrame(
        [
            {"sequence": f"{name:02d}", "rmse": (name + 1) * np.exp(random.normal(0, spread))}
            for name in range(4)
            for _ in range(repetitions)
        ]
    )


def test_the_null_distribution_agrees_with_order_statistics():
    assert (
        np.abs(ablations.null_distribution(errors(0), REPORTED).iloc[:, :3].to_numpy()).max() < 1e-9
    )
    spread = 0.2
    runs = errors(spread, 2000)
    table = ablations.null_distribution(runs, REPORTED)
    # a standard normal's least of 15 is -1.736 on average, its median 0
    assert table.loc["median", "expected"] == pytest.approx(
        100 * (np.exp(-1.736 * spread) - 1), abs=2.5
    )
    assert table.loc["mean", "low"] < table.loc["mean", "expected"] < table.loc["mean", "high"] < 0
    assert (table["share_as_low"] == 100).all()  # every study reports less than 0
    scaled = runs.assign(rmse=runs["rmse"] * runs["sequence"].astype(int).add(1) * 7)
    assert np.allclose(ablations.deviations(runs), ablations.deviations(scaled))
    single = ablations.null_distribution(errors(spread), REPORTED, widths=1)
    assert single.loc["median", "expected"] == pytest.approx(0, abs=1.5)


def test_tracks_of_a_known_motion_have_small_residuals_and_cover_fields():
    street = Street(3)
    street.size = street.images[0].shape
    corner = np.zeros(street.size, np.uint8)
    corner[60:100, 380:440] = 255
    table = ablations.tracks(
        street, {"all": None, "stripes": Stripes(40), "corner": [corner] * 3}, pairs=2
    )
    means = table.groupby("method")[["residual", "fields"]].mean()
    assert (means["residual"] < 1).all() and means.loc["corner", "fields"] < means.loc[
        "all", "fields"
    ]


def test_boundaries_between_close_ids_are_lost_and_between_distant_ids_found():
    label_map = np.full((320, 320), 7, np.uint8)
    label_map[:, 160:] = 8
    near = ablations.boundaries(label_map, (188, 620))
    label_map[:, 160:] = 23
    far = ablations.boundaries(label_map, (188, 620))
    assert (
        near["lost"] == 100 == near["road/sidewalk"]
        and far["lost"] == 0
        and np.isnan(far["road/sidewalk"])
    )
    assert (
        far["invented"]
        > 0
        == ablations.boundaries(np.full_like(label_map, 20), (188, 620))["invented"]
    )
