"""The plan: every notebook that runs odometry is in it, and it is near what a run really takes."""

import time

import pytest

from thesis_repro import kitti
from thesis_repro.cli import main
from thesis_repro.settings import PROFILES
from thesis_repro.study import plan, runner, series
from thesis_repro.study.sources import Source

pytestmark = pytest.mark.slow


def test_minutes_below_an_hour_and_hours_above():
    assert plan.duration(90) == "1.5 minutes" and plan.duration(5400) == "1.5 hours"


def test_the_complete_benchmark_is_multiplied(small_world, monkeypatch):
    cost = {"label map": 0.1, "run": 0.01, "single run": 0.02, "ablation": 0.01, "ablations": 100}
    monkeypatch.setattr(plan, "_thesis_seconds", None)  # runs in another process

    class Pool:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def submit(self, *_):
            return type("Future", (), {"result": staticmethod(lambda: cost)})

    monkeypatch.setattr(plan, "_pool", Pool)
    steps = []
    monkeypatch.setattr(plan, "text", lambda given, *_: steps.extend(given))
    sizes = PROFILES["thesis"]
    plan.of_thesis(small_world / "kitti", sizes, complete=True)
    seconds = {step.name[:2] + step.name.split()[1]: step.seconds for step in steps}
    # 80 thesis runs, 10 refined ones, 7 controls and 5 others times 5 and two estimators
    runs = 16 * 5 + 2 * 5 + 7 * 2 * 5 + 5 * 5
    assert seconds["08odometry"] == pytest.approx(23201 * runs * 0.01)
    assert seconds["05label"] == pytest.approx(2320.1) and seconds["09ablations"] == pytest.approx(23201)
    assert seconds["08timing"] == pytest.approx(11 * 200 * 16 * 0.02) and "07odometry" in seconds


def test_a_study_takes_about_as_long_as_planned(small_world, small_labels, tmp_path):
    """Loosely, since machines are busy."""
    study = series.Study(small_world / "kitti", ("00",), (Source(small_labels, name="net"),), (5, 10), 10)
    jobs = study.first_jobs()
    planned = plan._study_seconds(study, "00") * len(kitti.Sequence(study.kitti, "00")) * len(jobs)
    started = time.process_time()
    runner.run(jobs, study.kitti, study.sources, tmp_path)
    assert 1 / 3 < planned / (time.process_time() - started) < 3


def test_the_command_prints_a_table(small_world, small_labels, tmp_path, capsys):
    assert main(["study", "--kitti", str(small_world / "kitti"), "--labels", str(small_labels), "--widths", "5",
                 "--output", str(tmp_path / "out"), "--plan"]) == 0
    text = capsys.readouterr().out
    assert "2 sequences, 24 frames" in text and "20 runs" in text and "minutes" in text


@pytest.mark.parametrize("root, says", [("nowhere", "holds no folder 'sequences'"), ("TINY", "too short to plan from")])
def test_bad_input_is_one_clear_line(tiny_kitti, root, says, capsys):
    assert main(["plan", "--kitti", str(tiny_kitti) if root == "TINY" else root]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ") and says in error and "\n" not in error
