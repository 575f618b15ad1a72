import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro import InputError, experiments, figures_results, metrics, odometry, stages
from thesis_repro.experiments import Job
from thesis_repro.figures import markdown
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks

WIDTHS = (5, 10, 15)


@pytest.fixture(scope="module")
def labels(small_world, tmp_path_factory):
    """Label maps as notebook 5 leaves them: here the embedded world's true ones at 320x320."""
    root = tmp_path_factory.mktemp("labels")
    for name in ("00", "01"):
        stages.stage(root / name, model="none")
        for path in (small_world / "kitti" / "sequences" / name / "labels_0").glob("*.png"):
            true = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            cv2.imwrite(str(root / name / path.name), cv2.resize(true, (320, 320), interpolation=cv2.INTER_NEAREST))
    return root


@pytest.fixture(scope="module")
def finished(small_world, labels, tmp_path_factory):
    folder = tmp_path_factory.mktemp("odometry")
    jobs = experiments.first_jobs(["00", "01"], WIDTHS)
    summary = experiments.run(jobs, small_world / "kitti", labels, folder, processes=2)
    jobs += experiments.reduced_jobs(summary)
    return folder, jobs, experiments.run(jobs, small_world / "kitti", labels, folder, processes=2)


def test_a_run_is_the_odometry_of_its_sequence(small_world, labels, finished):
    folder, _, summary = finished
    assert len(summary) == 10
    sequence = Sequence(small_world / "kitti", "01")
    alone = odometry.run(sequence, masks=LabelMasks(labels / "01", sequence, 15))
    row = summary.set_index(["sequence", "run"]).loc["01", "masked-15-0"]
    assert row["rmse"] == metrics.rmse(alone.poses, sequence.poses)
    assert np.array_equal(experiments.paths(summary, folder)["01", "masked-15-0"], alone.poses[:, :3, 3])


def test_reduced_runs_have_the_keypoints_of_the_best_width(finished):
    _, _, summary = finished
    best = experiments.best_widths(summary)
    for name in ("00", "01"):
        of_name = summary[(summary["sequence"] == name) & (summary["variant"] == "masked")]
        assert best.loc[name, "rmse"] == of_name["rmse"].min()
        reduced = summary[(summary["sequence"] == name) & (summary["variant"] == "reduced")]
        assert reduced["max_keypoints"].item() == round(best.loc[name, "mean_keypoints"])


def test_finished_runs_are_not_run_again_and_missing_ones_are(small_world, labels, finished, monkeypatch):
    folder, jobs, summary = finished
    times = {path: path.stat().st_mtime_ns for path in folder.rglob("*.csv")}
    lost = folder / "00" / "masked-05-0.csv"
    lost.unlink()
    again = experiments.run(jobs, small_world / "kitti", labels, folder)
    assert {path for path in times if path.stat().st_mtime_ns != times[path]} == {lost}
    pd.testing.assert_frame_equal(again, summary)


def test_a_failing_run_is_reported_and_stops_no_other(small_world, labels, tmp_path, capsys):
    jobs = [Job("00", "baseline"), Job("00", "masked", dilation_width=0)]
    summary = experiments.run(jobs, small_world / "kitti", labels, tmp_path)
    assert list(summary["run"]) == ["baseline-0"]
    assert "sequence 00, masked-00-0: failed: dilation width 0" in capsys.readouterr().out
    with pytest.raises(InputError, match="all 1 odometry runs failed; the first: dilation width 0"):
        experiments.run(jobs[1:], small_world / "kitti", labels, tmp_path)


def test_a_killed_pass_goes_on_from_its_checkpoint(small_world, labels, finished, tmp_path, monkeypatch):
    folder, jobs, _ = finished
    jobs = [job for job in jobs if job.sequence == "00" and job.variant != "reduced"]
    monkeypatch.setattr(odometry, "CHECKPOINT", 5)
    read = []

    def frame(self, index, original=Sequence.frame):
        read.append(index)
        if index == 8 and len(read) < 12:
            raise OSError("pulled the plug")
        return original(self, index)

    monkeypatch.setattr(Sequence, "frame", frame)
    with pytest.raises(InputError, match="pulled the plug"):
        experiments.run(jobs, small_world / "kitti", labels, tmp_path)
    assert [path.name for path in (tmp_path / "00").glob("*") if path.suffix != ".json"] == ["checkpoint"]
    read.extend([None] * 12)
    experiments.run(jobs, small_world / "kitti", labels, tmp_path)
    assert read[-7:] == list(range(5, 12))
    for job in jobs:
        one, two = (pd.read_csv(root / "00" / f"{job.name}.csv") for root in (folder, tmp_path))
        exact = [column for column in one if not column.endswith("seconds")]
        pd.testing.assert_frame_equal(one[exact], two[exact], check_exact=True)


def test_runs_are_timed_once_and_on_their_own(small_world, labels, finished, monkeypatch):
    folder, jobs, _ = finished
    first = [job for job in jobs if job.variant != "reduced"]
    timed = experiments.time_runs(first, small_world / "kitti", labels, folder, frames=4)
    assert list(timed["run"]) == [job.name for job in first] and (timed["seconds"] > 0).all()
    again = experiments.time_runs(first, small_world / "kitti", labels, folder, frames=4)
    pd.testing.assert_frame_equal(timed, again)


def made_up(changes):
    """A summary with errors that change by the given percentages from a baseline of 2 m."""
    rows = []
    for name, change in changes.items():
        rows.append((name, "baseline", np.nan, 2.0, 2000, 10.0))
        rows += [(name, "masked", width, 2.0 * (1 + change / 100) + extra, 500 + width, 9.0)
                 for width, extra in ((5, 0.5), (10, 0.0), (15, 1.0))]
    table = pd.DataFrame(rows, columns=["sequence", "variant", "dilation_width", "rmse", "mean_keypoints", "seconds"])
    return table.assign(mae=table["rmse"], frames=100)


def test_the_thesis_tables_come_out_of_the_thesis_numbers():
    reported = figures_results.REPORTED["table_4_2_rmse_percent_change"]
    table = figures_results.table_of_change(made_up(reported), "rmse", "thesis").set_index("sequence")
    ours, theirs = table["change (%)"], table["change (%), thesis"]
    # what the thesis calls aggregate is the sum; its mean is a tenth of that and its median lower still
    assert ours["sum (the thesis's aggregate)"] == theirs["sum (the thesis's aggregate)"] == -13.2
    assert (ours["mean"], ours["median"], ours["sequences improved"]) == (-1.2, -5.27, 6)
    assert ours["05"] == theirs["05"] == 67.56
    widths = figures_results.table_4_1(made_up(reported), "thesis")
    assert set(widths["dilation width (pixels)"]) == {10} and widths["mean keypoints, thesis"].tolist()[:2] == [788, 500]


def test_time_savings_follow_equation_4_2():
    savings = figures_results.time_savings(made_up({"00": 0, "01": 0}))
    assert savings.to_dict() == pytest.approx({5: -10, 10: -10, 15: -10})


def test_markdown_table_aligns_numbers_and_leaves_missing_ones_empty():
    table = pd.DataFrame({"a": ["x", "y"], "b": [1.5, np.nan]})
    assert markdown(table) == "| a | b |\n| :--- | ---: |\n| x | 1.5 |\n| y |  |\n"
