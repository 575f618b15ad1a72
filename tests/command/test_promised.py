"""What docs/promises.md promises is what promised.txt records, so each change is a decision."""

import inspect
import json
from operator import attrgetter
from pathlib import Path

import pandas as pd
import trials

import opencv_exact
import thesis_repro as tr
from keypoint_study import comparisons, jobs, runner
from keypoint_study.report import comparison
from keypoint_study.sources import Source
from thesis_repro.command import cli
from thesis_repro.command.options import build_parser
from thesis_repro.odometry import OPENCV

RECORD = Path(__file__).with_name("promised.txt")
RUNS = trials.ROOT / "tests" / "keypoint_study" / "runs.csv"
EXACT = ("find_essential_matrix", "reason_for_opencv", "recover_pose", "track")
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


def called(name, value):
    """A name with its arguments, "run(sequence, settings=)"; "=" marks a default."""
    if not callable(value) or value is tr.InputError or getattr(value, "_is_protocol", False):
        return name
    arguments = [
        str(argument.replace(annotation=argument.empty)).partition("=")[0]
        + "=" * (argument.default is not argument.empty)
        for argument in inspect.signature(value).parameters.values()
        if argument.name != "self"
    ]
    return f"{name}({', '.join(arguments)})"


def of_python():
    names = [*tr.__all__, "Odometry.step", "Sequence.from_arrays"]
    names += ["Result.write_kitti", "Result.write_tum"]
    names += [f"SequenceLike.{name}" for name in vars(tr.SequenceLike) if name[0] != "_"]
    for name, value in inspect.getmembers(tr.metrics, inspect.isfunction):
        if value.__module__ == tr.metrics.__name__ and name[0] != "_":
            names.append(f"metrics.{name}")
    own = {called(name, value) for name, value in OPENCV._asdict().items()}
    return {
        "thesis_repro": {called(name, attrgetter(name)(tr)) for name in names},
        "opencv_exact": {called(name, getattr(opencv_exact, name)) for name in EXACT},
        "a file of --keypoints": own,
    }


def of_command_line():
    parser = build_parser(cli.COMMANDS)
    (commands,) = [action.choices for action in parser._actions if action.dest == "command"]
    groups = {}
    for name, each in {"thesis-repro": parser, **commands}.items():
        words = [action.option_strings or [action.metavar] for action in each._actions]
        groups[name] = {word for strings in words for word in strings} - {"-h", "--help", "COMMAND"}
    return groups


def of_tables(kitti, folder, capsys):
    """What programs read: the columns of tables and the keys of JSON."""
    sequence = tr.Sequence(kitti, "00")
    assert cli.main(["odometry", "--kitti", str(kitti), "--sequence", "00", "--json"]) == 0
    job = jobs.Job("00", "baseline")
    runs = runner.run_all(jobs.runs_of([job], [sequence], [Source(kitti)]), folder).table
    in_git = pd.read_csv(RUNS, dtype={"sequence": str}).fillna({"source": ""})
    compared = comparisons.comparisons_of(in_git)
    ratios = comparison.long_table_of_ratios(compared).content
    return {
        "odometry --json": {*json.loads(capsys.readouterr().out)},
        "runs.csv": {*runs},
        "runs/SEQUENCE/RUN.csv": {*pd.read_csv(folder / "00" / f"{job.name}.csv")},
        "ratios.csv": {*ratios} - {*in_git["sequence"]},
    }


def test_what_is_promised_is_what_is_recorded(tiny_kitti, tmp_path, capsys):
    now = of_python() | of_command_line() | of_tables(tiny_kitti, tmp_path, capsys)
    record = recorded()
    assert {*now} == {*record}, ADVICE
    for group, names in now.items():
        gone, new = sorted(record[group] - names), sorted(names - record[group])
        assert not gone + new, f"{group}: gone {gone}, new {new}; {ADVICE}"
