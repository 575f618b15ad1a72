"""The runs of a study: resuming, failures, their settings and their times."""

import shutil
import signal
import time

import cv2
import numpy as np
import pandas as pd
import pytest

from keypoint_study import comparisons, methods, runner
from keypoint_study.jobs import Job, first_jobs, runs_of
from keypoint_study.sources import Source
from thesis import tables, timing
from thesis_repro import masks, odometry
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import folders
from thesis_repro.odometry import metrics
from thesis_repro.odometry.keypoints import filtered
from thesis_repro.running import program, workers

WIDTHS = (5, 10, 15)


def opened(world, frames=None):
    return [Sequence(world / "kitti", name).subset(frames) for name in ("00", "01")]


@pytest.fixture(scope="module")
def finished(small_world, small_labels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("odometry")
    jobs = first_jobs(opened(small_world), {"thesis": WIDTHS})
    runs = runs_of(jobs, opened(small_world), [Source(small_labels)])
    summary = runner.run_all(runs, folder, processes=2).table
    jobs += tables.reduced_jobs(tables.best_widths(comparisons.of_method(summary, "masked")))
    runs = runs_of(jobs, opened(small_world), [Source(small_labels)])
    return folder, jobs, runner.run_all(runs, folder).table


def test_a_run_equals_the_odometry_of_its_sequence(small_world, small_labels, finished):
    folder, _, summary = finished
    assert len(summary) == 10
    sequence = Sequence(small_world / "kitti", "01")
    alone = odometry.run(sequence, masks=folders.LabelMasks(small_labels / "01", sequence, 15))
    row = summary.set_index(["sequence", "run"]).loc["01", "masked-15-0"]
    expected = metrics.errors(alone.poses, sequence.poses) | metrics.step_errors(
        alone.poses, sequence.poses
    )
    assert {name: row[name] for name in expected} == pytest.approx(expected, nan_ok=True, rel=0)
    assert row["se3"] <= row["rmse"]
    best = tables.best_widths(comparisons.of_method(summary, "masked")).loc["01"]
    least = summary[summary["sequence"] == "01"].groupby("method")[["rmse", "max_keypoints"]].min()
    assert best["rmse"] == least.loc["masked", "rmse"]
    assert least.loc["reduced", "max_keypoints"] == round(best["mean_keypoints"])
    assert np.array_equal(runner.run_poses(summary, folder)["01", "masked-15-0"], alone.poses)


def test_a_stopped_pass_is_repeated_and_ends_as_an_undisturbed_one(
    small_world, small_labels, finished, tmp_path, monkeypatch
):
    folder, jobs, _ = finished
    jobs = [job for job in jobs if job.method != "reduced"]

    def frame(self, index, original=Sequence.frame):
        if self.name == "01" and index == 8:
            raise OSError("pulled the plug")
        return original(self, index)

    with monkeypatch.context() as patch:
        patch.setattr(Sequence, "frame", frame)
        outcome = runner.run_all(
            runs_of(jobs, opened(small_world), [Source(small_labels)]), tmp_path
        )
    assert set(outcome.table["sequence"]) == {"00"} and len(outcome.reasons) == 4
    assert "pulled the plug" in outcome.warnings[0]
    times = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("*.csv")}
    runner.run_all(runs_of(jobs, opened(small_world), [Source(small_labels)]), tmp_path)
    assert times == {path: path.stat().st_mtime_ns for path in times} and len(times) == 4
    for job in jobs:
        whole, repeated = (
            pd.read_csv(root / job.sequence / f"{job.name}.csv") for root in (folder, tmp_path)
        )
        exact = [column for column in whole if not column.endswith("seconds")]
        pd.testing.assert_frame_equal(whole[exact], repeated[exact], check_exact=True)


def test_a_failed_run_is_reported_and_stops_no_other_run(
    small_world, small_labels, tmp_path, capsys
):
    shutil.copytree(small_labels, tmp_path / "labels")
    broken = tmp_path / "labels" / "00" / "000003.png"
    broken.write_bytes(broken.read_bytes()[:-20])
    program.print_messages()
    jobs = [
        *first_jobs(opened(small_world)[:1], {"thesis": WIDTHS}),
        Job("00", "true-labels", 10),
        Job("00", "mirrored", 10),
        Job("00", "masked", dilation_width=0),
    ]
    outcome = runner.run_all(
        runs_of(jobs, opened(small_world, 5), [Source(tmp_path / "labels")]), tmp_path / "runs"
    )
    assert (outcome.made, outcome.kept, len(outcome.reasons)) == (2, 0, len(jobs) - 2)
    assert list(outcome.table["run"]) == ["baseline-0", "true-labels-10-0"]
    printed = capsys.readouterr().err
    assert (
        f"sequence 00, masked-05-0, masked-10-0, masked-15-0, mirrored-10-0: failed: {broken}: "
        in printed
    )
    assert "sequence 00, masked-00-0: failed: dilation width 0" in printed
    with pytest.raises(InputError, match="all 1 runs failed; the first: dilation width 0"):
        runner.run_all(
            runs_of(jobs[-1:], opened(small_world), [Source(small_labels)]),
            tmp_path / "none",
        )


def test_a_sequence_without_structure_has_no_result(tiny_kitti, tmp_path):
    shutil.copytree(tiny_kitti / "sequences" / "00", tiny_kitti / "sequences" / "01")
    shutil.copy(tiny_kitti / "poses" / "00.txt", tiny_kitti / "poses" / "01.txt")
    for path in (tiny_kitti / "sequences" / "01" / "image_0").iterdir():
        cv2.imwrite(str(path), np.full((48, 64), 128, np.uint8))
    sequences = [Sequence(tiny_kitti, name) for name in ("00", "01")]
    jobs = [Job(name, "baseline", repetition=number) for name in ("00", "01") for number in (0, 1)]
    outcome = runner.run_all(
        runs_of(jobs, sequences, [Source(tmp_path / "none")]), tmp_path / "runs"
    )
    assert (outcome.made, outcome.kept, len(outcome.reasons)) == (2, 0, 2)
    assert set(outcome.table["sequence"]) == {"00"}
    assert len(outcome.warnings) == 1 and "sequence 01, " in outcome.warnings[0]
    with pytest.raises(InputError, match="sequence 01: "):
        runner.run_all(runs_of(jobs[2:], sequences, [Source(tmp_path / "none")]), tmp_path / "runs")


def test_a_run_with_other_settings_is_made_again_and_no_other(small_world, small_labels, tmp_path):
    jobs = [Job("00", "baseline"), Job("00", "masked", 5)]
    given = jobs, opened(small_world, 4), [Source(small_labels)]
    first = runner.run_all(runs_of(*given), tmp_path)
    runs = runs_of(*given, masked_settings={"detector": filtered})
    changed, again = runner.run_all(runs, tmp_path), runner.run_all(runs, tmp_path)
    assert [(each.made, each.kept) for each in (first, changed, again)] == [(2, 0), (1, 1), (0, 2)]
    keypoints = [each.table["mean_keypoints"].tolist() for each in (first, changed)]
    assert keypoints[0][0] == keypoints[1][0] and keypoints[0][1] != keypoints[1][1]


def test_masks_of_static_things_have_no_width_and_their_controls_are_what_they_are_called(
    small_world, small_labels
):
    sequence = opened(small_world, 4)[0]
    source = Source(small_labels, settings=masks.MaskSettings(keep="static"))
    jobs = first_jobs([sequence], {"thesis": ()}, tested=5, sources=[source])
    runs = runs_of(jobs, [sequence], [source])
    assert list(runs) == jobs
    made = {job.method: (job.dilation_width, run[2]) for job, run in runs.items()}
    assert [made[name][0] for name in ("masked", "mirrored")] == [None, None]
    width, exact = made["exact-boundaries"]
    plain = folders.LabelMasks(small_labels, sequence, 5, masks.MaskSettings("exact"))
    assert width == 5 and np.array_equal(exact[1], plain[1])
    assert np.array_equal(made["masked"][1][1], made["static"][1][1])


def test_first_jobs_are_complete_and_have_different_names(small_world, tiny_kitti):
    label_maps, ready = Source(tiny_kitti, name="net"), Source(tiny_kitti, "masks", "ready")
    jobs = first_jobs(
        opened(small_world)[:1],
        {"thesis": (5, 10), "refined": ()},
        tested=10,
        sources=(label_maps, ready),
        repetitions=2,
    )
    assert len({job.name for job in jobs}) == len(jobs)
    rows = pd.DataFrame([vars(job) for job in jobs])
    count = rows.groupby(["source", "method", "estimator"]).size()
    # once for all sources
    assert count["", "baseline", "thesis"] == count["", "baseline", "refined"] == 2
    assert count["net", "masked", "thesis"] == 4 and count["net", "masked", "refined"] == 2
    assert count["ready", "masked", "refined"] == 2
    assert rows.loc[rows["source"] == "ready", "dilation_width"].isna().all()
    net, ready_made = (set(rows.loc[rows["source"] == name, "method"]) for name in ("net", "ready"))
    # no list names them: what is in the table runs
    of_labels, controls = (
        set(methods.of_group(group)) for group in (methods.LABEL_MAPS, methods.CONTROL)
    )
    assert net == {"masked", *of_labels, *controls} - {"fewer", "spread"}
    assert controls == {
        *["other-frame", "mirrored", "random-lines", "image-edges", "fewer", "spread"]
    }
    of_masks = "exact-boundaries corrected static-boundaries static inverse true-labels"
    assert of_labels == {*of_masks.split()}  # a new one joins every study only if it is meant to
    assert net - ready_made == of_labels
    without_truth = first_jobs([Sequence(tiny_kitti, "00")], {"thesis": (5,)}, tested=5)
    assert "true-labels" not in {job.method for job in without_truth}


# The time of a frame, stage by stage; the timed steps are the steps of a real run


def test_a_slow_stage_shows_in_its_row(small_world, small_model, monkeypatch):
    from thesis_repro.segmentation import training

    sequence = opened(small_world)[0]
    keypoint_mask = masks.keypoint_mask
    monkeypatch.setattr(
        masks, "keypoint_mask", lambda *given: (keypoint_mask(*given), time.sleep(0.3))[0]
    )
    table = timing.time_stages(sequence, training.load_model(small_model), width=5, frames=2)
    assert (
        list(table.columns) == ["method", "stage", "milliseconds"]
        and (table["milliseconds"] > 0).all()
    )
    stages_of = table.groupby("method")["stage"].agg(list)
    steps = ["detection", "tracking", "pose"]
    assert stages_of["masked, width 5"] == ["read", "segmentation", "mask", *steps]
    assert stages_of["all keypoints"] == ["read", *steps]
    slow = table.set_index(["method", "stage"])["milliseconds"]
    assert slow["masked, width 5", "mask"] > 300 > slow.drop(("masked, width 5", "mask")).max()


def test_worker_processes_leave_ctrl_c_to_their_parent():
    with workers.open_pool(2) as pool:
        handlers = list(pool.run(signal.getsignal, [(signal.SIGINT,), (signal.SIGINT,)]))
    assert handlers == [signal.SIG_IGN] * 2


def test_a_killed_worker_is_one_line_and_the_next_call_works():
    with pytest.raises(InputError, match="a worker process was lost"), workers.open_pool(2) as pool:
        list(pool.run(signal.raise_signal, [(signal.SIGKILL,)]))
    with workers.open_pool(2) as pool:
        assert list(pool.run(abs, [(-2,), (-1,)])) == [2, 1]
