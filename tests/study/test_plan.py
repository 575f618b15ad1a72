"""The planned time: it includes every notebook that runs odometry and is near the real time."""

import time
from dataclasses import replace

import pytest

from thesis_repro.cli import main
from thesis_repro.settings import PROFILES
from thesis_repro.study import plan, runner
from thesis_repro.study.sources import Source
from thesis_repro.study.study import Study

pytestmark = pytest.mark.slow


def test_the_plan_includes_every_notebook(small_world, monkeypatch, tmp_path):
    # thesis runs, refined runs, and 11 controls with two estimators
    first = 16 * 5 + 2 * 5 + 11 * 2 * 5
    runs = first + 5 * 5
    monkeypatch.setattr(plan, "_seconds", lambda run: (0, 0.1))
    monkeypatch.setattr(plan, "cores", lambda: 2)
    planned = plan.of_thesis(small_world / "kitti", PROFILES["thesis"], tmp_path)
    seconds = {name: seconds for name, _, _, seconds in planned["steps"]}
    assert seconds == pytest.approx(
        {
            "05: label maps": 2.4,
            "07: one sequence": 12 * plan.RUNS_IN_07 * 0.1,
            "08: odometry": 24 * runs / first * 0.1,
            "08: timing of every width": 24 * 16 * 0.1,
            "09: ablations": 2.4,
        }
    )
    assert planned["on_all_cores"] == pytest.approx(planned["once"] + sum(seconds.values()) / 2)


def test_a_study_takes_about_as_long_as_planned(small_world, small_labels, tmp_path):
    study = Study(small_world / "kitti", ("00",), (Source(small_labels, name="net"),), (5, 10))
    planned = plan.of_study(study, tmp_path)
    assert planned["steps"][0][1:3] == (3, "runs")
    started = time.process_time()
    runner.run(study.first_jobs(), study.opened, study.sources, tmp_path / "runs")
    assert 1 / 3 < planned["steps"][0][-1] / (time.process_time() - started) < 3
    assert plan.of_study(study, tmp_path)["steps"][0][1:] == (0, "runs", 0)  # all is done
    with_controls = replace(study, widths=(5,), tested=5)
    folder = tmp_path / "with_controls"
    assert plan.of_study(with_controls, folder)["steps"][0][1] > 2
    with_controls.run(folder)
    assert plan.of_study(with_controls, folder)["steps"][0][1] == 0


def test_the_command_prints_a_table(small_world, small_labels, tiny_kitti, tmp_path, capsys):
    assert (
        main(
            [
                "study",
                "--kitti",
                str(small_world / "kitti"),
                "--labels",
                str(small_labels),
                "--widths",
                "5",
                "--output",
                str(tmp_path / "out"),
                "--plan",
            ]
        )
        == 0
    )
    text = capsys.readouterr().out
    assert "2 sequences, 24 frames" in text and "20 runs" in text and " s\n" in text
    assert "at least 6" in text  # sequences, for a verdict
    assert main(["plan", "--kitti", str(tiny_kitti)]) == 1
    assert "too short" in capsys.readouterr().err
