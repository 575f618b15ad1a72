"""The time of a frame: the stages are those of the chain that the label maps, masks and runs on disk go through."""

import time

import cv2
import keras
import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError, cityscapes, masks, odometry, stages
from thesis_repro.kitti import Sequence
from thesis_repro.segmentation import prediction, training
from thesis_repro.segmentation.unet import build_unet
from thesis_repro.study import timing

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model():
    keras.utils.set_random_seed(0)
    return build_unet((64, 64, 1), cityscapes.N_CLASSES, 4)


@pytest.fixture
def sequence(small_world):
    return Sequence(small_world / "kitti", "00")


def test_every_stage_of_both_variants_takes_time(sequence, model):
    table = timing.measure(sequence, model, frames=4)
    assert list(table.columns) == ["method", "stage", "milliseconds"] and (table["milliseconds"] > 0).all()
    by_variant = table.groupby("method")["stage"].agg(list)
    assert by_variant["masked, width 10"] == list(timing.STAGES)
    assert by_variant["all keypoints"] == [stage for stage in timing.STAGES if stage not in ("segmentation", "mask")]


def test_the_masks_may_have_another_width(sequence, model, monkeypatch):
    asked = []
    keypoint_mask = masks.keypoint_mask
    monkeypatch.setattr(masks, "keypoint_mask", lambda *given: asked.append(given[2:]) or keypoint_mask(*given))
    for measure in (timing.measure, timing.measure_overlapped):
        table = measure(sequence, model, frames=2, width=5, boundaries="exact")
        assert list(table["method"].unique()) == ["all keypoints", "masked, width 5"]
    assert set(asked) == {(5, "exact")}


def test_a_slow_stage_shows_where_it_is(sequence, model, monkeypatch):
    fast = timing.measure(sequence, model, frames=4).set_index(["method", "stage"])["milliseconds"]
    keypoint_mask = masks.keypoint_mask
    monkeypatch.setattr(masks, "keypoint_mask", lambda *given: (keypoint_mask(*given), time.sleep(0.5))[0])
    slow = timing.measure(sequence, model, frames=4).set_index(["method", "stage"])["milliseconds"]
    assert slow["masked, width 10", "mask"] > 500 > fast["masked, width 10", "mask"]
    assert slow.drop(("masked, width 10", "mask")).max() < 500


def test_its_masks_are_those_from_written_label_maps(sequence, model, tmp_path):
    prediction.write_label_maps(model, sequence.frame_paths[:1], tmp_path)
    frame = sequence.frame(0)
    for width, boundaries in ((10, "canny"), (5, "exact")):
        mask = timing._mask(timing._segment(model, frame), frame.shape, width, boundaries)
        assert np.array_equal(mask, masks.LabelMasks(tmp_path, sequence.subset(1), width, boundaries)[0])


def test_its_steps_are_those_of_a_run(sequence, model, monkeypatch):
    seen = []
    step = odometry.Odometry.step
    monkeypatch.setattr(odometry.Odometry, "step", lambda *given: seen.append(step(*given)) or seen[-1])
    timing.measure_overlapped(sequence, model, frames=4)
    short = sequence.subset(7)
    made = [masks.keypoint_mask(cv2.resize(label_map, (320, 320), interpolation=cv2.INTER_NEAREST), short.size, 10)
            for label_map in prediction.predict(model, np.stack(
                [cityscapes.read_image(path, 64, 64) for path in short.frame_paths]))]
    assert 0 < min(map(masks.coverage, made)) and max(map(masks.coverage, made)) < 1
    for steps, expected in ((seen[:7], odometry.run(short)), (seen[7:], odometry.run(short, masks=made))):
        assert np.array_equal([one.pose for one in steps], expected.poses)
        assert [one.detected for one in steps] == expected.frames["detected"].tolist()


def test_overlapping_hides_the_shorter_side(sequence, model, monkeypatch):
    segment = timing._segment
    monkeypatch.setattr(timing, "_segment", lambda *given: (time.sleep(0.5), segment(*given))[1])
    step = odometry.Odometry.step
    monkeypatch.setattr(odometry.Odometry, "step", lambda *given: (time.sleep(0.5), step(*given))[1])
    table = timing.measure_overlapped(sequence, model, frames=4).set_index("method")["milliseconds"]
    assert (table >= 499).all() and (table < 990).all()


def test_it_is_measured_once_for_a_model(sequence, model, tmp_path, monkeypatch):
    training_file = tmp_path / "model.keras"
    model.save(training_file)
    first = timing.frame_times(tmp_path / "timing", sequence, training_file, frames=3)
    monkeypatch.setattr(training, "load_model", lambda path: pytest.fail("measured again"))
    second = timing.frame_times(tmp_path / "timing", sequence, training_file, frames=3)
    assert all(one.equals(other) for one, other in zip(first, second))
    with pytest.raises(pytest.fail.Exception, match="measured again"):
        timing.frame_times(tmp_path / "timing", sequence, training_file, frames=3, width=5)
    monkeypatch.setattr(stages, "content", lambda path: "another model")
    with pytest.raises(pytest.fail.Exception, match="measured again"):
        timing.frame_times(tmp_path / "timing", sequence, training_file, frames=3)


def test_too_few_frames_are_one_clear_line(sequence, model):
    with pytest.raises(InputError, match="sequence 00: 3 frames; timing needs 5 or more"):
        timing.measure(sequence.subset(3), model)


def test_figures_in_git_keep_the_timings_that_came_with_them(tmp_path):
    path = tmp_path / "timings" / "seconds.csv"
    first, second = (pd.DataFrame({"sequence": ["00"], "seconds": [value]}) for value in (1.5, 2.5))
    assert timing.recorded(first, path, keep=True).equals(first)  # there were none
    assert timing.recorded(second, path, keep=True).equals(first)
    assert timing.recorded(second, path, keep=False).equals(second)
    assert timing.recorded(first, path, keep=True).equals(second)
