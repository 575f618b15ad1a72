"""What docs/promises.md promises is what promised.txt records, so each change is a decision."""

from pathlib import Path

import pandas as pd
import trials

import thesis_repro as tr
import write_texts
from keypoint_study import comparisons, jobs, runner
from keypoint_study.report import comparison
from keypoint_study.sources import Source

RECORD = Path(__file__).with_name("promised.txt")
RUNS = trials.ROOT / "tests" / "keypoint_study" / "runs.csv"
ADVICE = (
    "if this is meant: change tests/command/promised.txt, tell it in CHANGELOG.md, and look into "
    "docs/promises.md; before a name goes, a version warns"
)


def recorded():
    groups = {}
    for line in RECORD.read_text(encoding="utf-8").splitlines():
        if line.startswith("["):
            names = groups[line.strip("[]")] = set()
        elif line and not line.startswith("#"):
            names.add(line)
    return groups


def options():
    groups = {}
    for name, each in write_texts.commands().items():
        words = [action.option_strings or [action.metavar] for action in each._actions]
        groups[name] = {word for strings in words for word in strings} - {"-h", "--help"}
    return groups


def columns(kitti, folder):
    """Those of the tables of a study that programs read."""
    job, sequence = jobs.Job("00", "baseline"), tr.Sequence(kitti, "00")
    runs = runner.run_all(jobs.runs_of([job], [sequence], [Source(kitti)]), folder).table
    in_git = pd.read_csv(RUNS, dtype={"sequence": str}).fillna({"source": ""})
    ratios = comparison.long_table_of_ratios(comparisons.comparisons_of(in_git)).content
    return {
        "runs.csv": {*runs},
        "runs/SEQUENCE/RUN.csv": {*pd.read_csv(folder / "00" / f"{job.name}.csv")},
        "ratios.csv": {*ratios} - {*in_git["sequence"]},
    }


def test_what_is_promised_is_what_is_recorded(tiny_kitti, tmp_path):
    now = {"thesis_repro": {*tr.__all__}} | options() | columns(tiny_kitti, tmp_path)
    record = recorded()
    assert {*now} == {*record}, ADVICE
    for group, names in now.items():
        gone, new = sorted(record[group] - names), sorted(names - record[group])
        assert not gone + new, f"{group}: gone {gone}, new {new}; {ADVICE}"
