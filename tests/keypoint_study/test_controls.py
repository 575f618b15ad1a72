"""Controls, ablations and the null distribution of the thesis's procedure."""

import inspect
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from keypoint_study import ablations, comparisons, controls, jobs, methods, runner
from keypoint_study.jobs import first_jobs, runs_of
from keypoint_study.methods import Asked
from keypoint_study.sources import Source
from thesis import tables
from thesis_repro import masks
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks import folders
from thesis_repro.odometry import THESIS, OdometrySettings, keypoints
from thesis_repro.odometry.loop import detect

WIDTH = 10


@pytest.fixture(scope="module")
def sequence(small_world):
    return Sequence(small_world / "kitti", "00")


@pytest.fixture(scope="module")
def made(sequence, small_labels):
    """Masks of every control and of the thesis, by method."""
    source = Source(small_labels)
    by_method = {"masked": folders.LabelMasks(small_labels / "00", sequence, WIDTH)}
    for method in methods.MASK_CONTROLS:
        _, by_method[method] = methods.METHODS[method].choose(Asked(sequence, source))
    return by_method


def test_masks_of_controls_are_valid_and_repeatable(sequence, made):
    for method, source in made.items():
        assert len(source) == len(sequence)
        mask = source[3]
        assert mask.shape == sequence.size and mask.dtype == np.uint8, method
        assert set(np.unique(mask)) == {0, 255}, method
        assert mask.flags.c_contiguous, method
        source[7]
        assert np.array_equal(source[3], mask), method
        is_thesis_mask = np.array_equal(mask, made["masked"][3])
        assert is_thesis_mask == (method == "masked"), method


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
        expected = masks.keypoint_mask(label_map, sequence.size, WIDTH, settings)
        assert np.array_equal(made[method][5], expected), method


@pytest.mark.parametrize(
    "name",
    [name for name in methods.MASK_CONTROLS if methods.METHODS[name].group == methods.CONTROL],
)
def test_a_control_keeps_as_many_pixels_of_each_frame_as_the_masks(made, name):
    """A new entry of the table is here, too; one that is drawn inside out fails."""
    shares = [masks.coverage(made[name][index]) for index in range(12)]
    expected = [masks.coverage(made["masked"][index]) for index in range(12)]
    if name == "other-frame":  # as many in other frames
        shares, expected = sorted(shares), sorted(expected)
    assert shares == pytest.approx(expected, abs=0.01)
    assert min(expected) > 0.05 and max(expected) < 0.95


def test_a_methods_own_settings_win_over_those_of_a_study(sequence, small_labels, monkeypatch):
    orb_on_masks = methods.found_by(keypoints.orb, methods.masked)
    own = methods.Method("ORB on masks", methods.CONTROL, orb_on_masks)
    monkeypatch.setitem(methods.METHODS, "orb-on-masks", own)
    monkeypatch.setattr(jobs, "MASK_CONTROLS", [*methods.MASK_CONTROLS, "orb-on-masks"])
    source, few = Source(small_labels), {"detector": keypoints.spread(200)}
    planned = first_jobs([sequence], {"thesis": (WIDTH,)}, tested=WIDTH)
    runs = runs_of(planned, [sequence], [source], {"scale_gate": 0.5}, few)
    settings = {job.method: run.settings for job, run in runs.items()}
    assert settings["masked"].detector == keypoints.spread(200)
    assert settings["orb-on-masks"] == replace(THESIS, detector=keypoints.orb, scale_gate=0.5)
    assert settings["mirrored"].detector == keypoints.spread(200)
    filled = methods.changed(OdometrySettings(detector=keypoints.filled(methods.FILL)), few)
    assert filled.detector == keypoints.filled(methods.FILL, keypoints.spread(200))


@pytest.mark.parametrize("group, count", [(methods.ABLATION, 15), (methods.FEW, 6)])
def test_ablations_and_few_keypoints_are_those_of_the_one_table(group, count):
    assert len(methods.of_group(group)) == count


def test_masks_hold_for_five_frames_or_jump_by_as_many_in_each():
    numbers = np.arange(1000)  # of frames, in place of their masks
    held, jumping = (
        np.array([ablations.earlier_mask(numbers, steady, index) for index in numbers])
        for steady in (True, False)
    )
    assert (held == numbers // 5 * 5).all()
    lags = (numbers - jumping)[4:]
    assert set(lags) == {0, 1, 2, 3, 4} and lags.mean() == pytest.approx(2, abs=0.15)


MADE_FROM = {  # another value of each argument
    "dilation_width": 7,
    "settings": masks.MaskSettings(margin=3),
    "ids": "train",
    "invert": True,
    "make": controls.other_frame,
    "given": ["other masks"],
    "values": (3,),
}


@pytest.mark.parametrize("kind", [folders.LabelMasks, folders.MaskFolder, controls.MadeMasks])
def test_each_argument_of_masks_is_in_their_record(sequence, small_labels, kind):
    """A new argument fails here until it has another value above. Files are recorded apart."""
    given = {"folder": small_labels / "00", "sequence": sequence, "dilation_width": 5}
    given |= {"make": controls.mirrored, "given": ["masks"]}
    taken = list(inspect.signature(kind).parameters)
    plain = {name: given[name] for name in taken if name in given}
    record = kind(**plain).record()
    assert kind(**plain).record() == record
    for name in set(taken) - {"folder", "sequence"}:
        assert kind(**plain | {name: MADE_FROM[name]}).record() != record, name


def test_random_keypoints_on_a_mask_are_keypoints_there_drawn_again_alike(sequence, small_labels):
    asked = Asked(sequence, Source(small_labels), number=20)
    _, drawn = methods.METHODS["random-on"].choose(asked)
    _, given = methods.METHODS["masked"].choose(asked)
    found = detect(sequence.frame(3), THESIS, given[3]).astype(int)
    rows, columns = np.nonzero(drawn[3])
    assert 0 < len(rows) <= 20
    assert {*zip(columns, rows)} < {*map(tuple, found.tolist())}
    assert np.array_equal(drawn[3], drawn[3]) and not np.array_equal(drawn[3], drawn[2])


def test_random_lines_are_dilated_and_image_edges_lie_on_strong_edges(sequence, made):
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


def test_spread_keypoints_have_the_asked_number(sequence):
    counts = [len(detect(frame, THESIS)) for frame in sequence]
    target = np.mean(counts) / 2
    distance = controls.min_distance(sequence, target)
    assert distance > THESIS.min_distance and distance == round(distance, 1)
    spread = replace(THESIS, min_distance=distance)
    left = np.mean([len(detect(frame, spread)) for frame in sequence])
    assert left == pytest.approx(target, rel=0.03)
    assert controls.min_distance(sequence, max(counts)) == THESIS.min_distance


def test_controls_leave_as_many_keypoints_as_masks_of_the_tested_width(
    small_world, small_labels, tmp_path
):
    opened = [Sequence(small_world / "kitti", "00").subset(5)]
    jobs = first_jobs(opened, {"thesis": (5, WIDTH), "refined": ()}, tested=5)
    assert {job.dilation_width for job in jobs if job.method in methods.MASK_CONTROLS} == {5}
    runs = runner.run_all(runs_of(jobs, opened, [Source(small_labels)]), tmp_path).table
    left = comparisons.keypoints_left(runs, "")
    masked = comparisons.of_method(runs, "masked")
    jobs += tables.reduced_jobs(tables.best_widths(masked))
    jobs += runner.keypoint_controls(runs, opened, [Source(small_labels)], 1, 5)
    assert len({job.name for job in jobs}) == len(jobs)
    runs = runner.run_all(runs_of(jobs, opened, [Source(small_labels)]), tmp_path).table.set_index(
        "run"
    )
    assert list(runs.index) == [job.name for job in jobs] and comparisons.tested_width(runs) == 5
    number = runs["mean_keypoints"]
    assert left["00"] == number["masked-05-0"] < number["masked-10-0"]
    fewer = number[number.index.str.startswith("fewer")]
    spread = number[number.index.str.startswith("spread")]
    assert fewer.iloc[0] == pytest.approx(left["00"], abs=1)
    assert spread.iloc[0] == pytest.approx(left["00"], rel=0.05)


# Ablations


def test_every_ablation_differs_from_its_reference_in_one_thing(small_world, small_labels):
    sequence = Sequence(small_world / "kitti", "00").subset(4)
    listed = [jobs.Job("00", name) for name in ("masked", *methods.of_group(methods.ABLATION))]
    made = runs_of(listed, [sequence], [Source(small_labels)])
    runs = {job.method: (run.settings, run.masks) for job, run in made.items()}
    settings, thesis_masks = runs["masked"]
    assert settings == THESIS
    expected = folders.LabelMasks(small_labels / "00", sequence, 10)
    assert np.array_equal(thesis_masks[0], expected[0])
    dropped, same = runs["filter"]
    assert dropped.detector is keypoints.filtered and same is thesis_masks
    _, method_masks = runs["symmetric"]
    assert not np.array_equal(method_masks[0], thesis_masks[0])
    assert 0.5 < method_masks[0].sum() / thesis_masks[0].sum() < 2
    label_map = cv2.imread(str(small_labels / "00" / sequence.frame_paths[0].name), 0)
    enlarged = cv2.resize(label_map, sequence.size[::-1], interpolation=cv2.INTER_NEAREST)
    _, method_masks = runs["no-vegetation"]
    assert np.array_equal(method_masks[0] == 0, np.isin(enlarged, (21, 22)))


def test_keypoints_are_divided_by_their_parallax(small_world):
    sequence = Sequence(small_world / "kitti", "00").subset(3)
    points, distances = ablations.parallax(sequence, 1)
    spans = ((0, 3), (3, 20), (20, np.inf))
    kept = [ablations.with_parallax(sequence, *span, 1) > 0 for span in spans]
    assert [mask.sum() for mask in kept] == [
        ((distances >= low) & (distances < high)).sum() for low, high in spans
    ]
    assert sum(mask.sum() for mask in kept) == len(points) > 100
    drawn = ablations.as_many(sequence, *spans[0], 1)
    assert np.count_nonzero(drawn) == kept[0].sum() and not np.array_equal(drawn > 0, kept[0])
    assert not ablations.with_parallax(sequence, *spans[0], 2).any()  # no frame follows the last


@pytest.mark.parametrize("degrees, kept_half", [(3, "right"), (-3, "left"), (0.5, "both")])
def test_the_half_that_the_camera_turns_into_is_kept(degrees, kept_half):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix()
    turning = SimpleNamespace(size=(4, 10), poses=poses)
    mask, other = (ablations.half_in_turns(turning, into, 0) for into in (True, False))
    halves = {"left": mask[:, :5].all(), "right": mask[:, 5:].all()}
    assert {name for name, whole in halves.items() if whole} == (
        {"left", "right"} if kept_half == "both" else {kept_half}
    )
    assert np.array_equal(other == 0, mask > 0) or kept_half == "both"
    assert ablations.half_in_turns(turning, True, 1).all()  # the last frame
