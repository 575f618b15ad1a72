"""The time of a frame, stage by stage; the timed steps are the steps of a real run."""

import time

import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError, masks, odometry
from thesis_repro.kitti import Sequence
from thesis_repro.segmentation import prediction, training
from thesis_repro.study import timing

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def model(small_model):
    return training.load_model(small_model)


@pytest.fixture
def sequence(small_world, monkeypatch):
    monkeypatch.setattr(timing, "FRAMES", 2)
    return Sequence(small_world / "kitti", "00")


def test_a_slow_stage_shows_in_its_row(sequence, model, monkeypatch):
    keypoint_mask = masks.keypoint_mask
    monkeypatch.setattr(
        masks, "keypoint_mask", lambda *given: (keypoint_mask(*given), time.sleep(0.5))[0]
    )
    table = timing.measure(sequence, model, width=5)
    assert (
        list(table.columns) == ["method", "stage", "milliseconds"]
        and (table["milliseconds"] > 0).all()
    )
    stages_of = table.groupby("method")["stage"].agg(list)
    assert stages_of["masked, width 5"] == list(timing.STAGES)
    assert stages_of["all keypoints"] == [
        stage for stage in timing.STAGES if stage not in ("segmentation", "mask")
    ]
    slow = table.set_index(["method", "stage"])["milliseconds"]
    assert slow["masked, width 5", "mask"] > 500 > slow.drop(("masked, width 5", "mask")).max()


def test_timed_steps_equal_the_steps_of_a_run(sequence, model, tmp_path, monkeypatch):
    steps = []
    step = odometry.Odometry.step
    monkeypatch.setattr(
        odometry.Odometry, "step", lambda *given: steps.append(step(*given)) or steps[-1]
    )
    timing.measure(sequence, model, 5)
    short = sequence.subset(5)
    prediction.write_label_maps(model, short.frame_paths, tmp_path)
    made = masks.LabelMasks(tmp_path, short, 5)
    for timed, expected in (
        (steps[:10:2], odometry.run(short)),
        (steps[1:10:2], odometry.run(short, masks=made)),
    ):
        assert np.array_equal([timed_step.pose for timed_step in timed], expected.poses)
        assert [timed_step.detected for timed_step in timed] == expected.frames["detected"].tolist()


def test_too_few_frames_are_refused(sequence, model):
    with pytest.raises(InputError, match="sequence 00: 3 frames"):
        timing.measure(sequence.subset(3), model)


def test_recorded_timings_are_kept(tmp_path):
    path = tmp_path / "timings" / "seconds.csv"
    first, second = (pd.DataFrame({"sequence": ["00"], "seconds": [value]}) for value in (1.5, 2.5))
    assert timing.recorded(first, path, keep=True)[[*first]].equals(first)  # nothing was recorded
    assert timing.recorded(second, path, keep=True)[[*first]].equals(first)
    assert timing.recorded(second, path, keep=False)[[*first]].equals(second)
