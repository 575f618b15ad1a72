"""A study of the embedded world gives the same table of runs, to the last bit, on every machine.

runs.csv was written by version 0.12.0, before the odometry was put on one page.
"""

from pathlib import Path

from thesis_repro.study.sources import Source
from thesis_repro.study.study import Study

GOLDEN = Path(__file__).with_name("runs.csv")


def test_the_runs_of_a_study_are_those_in_git(small_world, small_labels, tmp_path):
    study = Study(
        small_world / "kitti",
        ("00", "01"),
        (Source(small_labels, name="net"),),
        widths=(10,),
        tested=10,
        estimators=("thesis", "refined"),
    )
    outcome = study.run(tmp_path)
    assert outcome.table.to_csv(index=False) == GOLDEN.read_text()
    assert (outcome.made, outcome.kept, outcome.failed_jobs) == (len(outcome.table), 0, 0)
