"""Times: which are shown, and what they say about themselves."""

import pandas as pd
import pytest

import timings
from keypoint_study.sources import Source
from thesis import real_frames, timing
from thesis.run_settings import read_settings
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError

MEASURED = pd.DataFrame({"sequence": ["00"], "seconds": [0.25]})


@pytest.fixture
def settings(tmp_path):
    """Of a run on frames of the user's, whose figures are not in git."""
    (tmp_path / "kitti").mkdir()
    names = {name: tmp_path / name.lower() for name in ("KITTI", "BUILD", "FIGURES")}
    names["PROFILE"] = "smoke"
    return read_settings({f"THESIS_REPRO_{name}": str(value) for name, value in names.items()})


def test_frames_are_timed_once_with_machine_date_version_and_sizes(settings):
    with pytest.raises(InputError, match="seconds.csv: .*08_results"):
        timing.times(settings, "seconds")
    table = timing.times(settings, "seconds", lambda: MEASURED)
    assert table["seconds"].tolist() == [0.25] and table["sequence"].tolist() == ["00"]
    for name, text in timing.circumstances(settings).items():
        assert table[name].tolist() == [text] and text in timing.told(table)
    again = MEASURED.assign(seconds=1.0)
    assert timing.times(settings, "seconds", lambda: again).equals(table)
    assert timing.times(settings, "seconds", lambda: again, anew=True)["seconds"].tolist() == [1]


@pytest.mark.parametrize("run", ["demo", "smoke", "evidence"])
def test_what_a_machine_measures_changes_no_figure_in_git(monkeypatch, tmp_path, run):
    names = {"THESIS_REPRO_BUILD": str(tmp_path / "build"), "THESIS_REPRO_PROFILE": run}
    if run == "evidence":
        names |= {"THESIS_REPRO_PROFILE": "thesis", "THESIS_REPRO_KITTI": str(tmp_path)}
    settings = read_settings(names)
    if run == "evidence":
        monkeypatch.setattr(real_frames, "is_evidence", lambda _: True)
        monkeypatch.setattr(real_frames, "FOLDER", tmp_path)
        (tmp_path / "timings").mkdir()
        MEASURED.assign(seconds=7.0).to_csv(tmp_path / "timings/seconds.csv")
    path = timing.folder(settings) / "seconds.csv"
    before = path.read_bytes()
    shown = timing.times(settings, "seconds", lambda: MEASURED)
    assert len(shown) and 0.25 not in shown["seconds"].tolist()
    assert path.read_bytes() == before


def test_another_run_of_the_embedded_world_does_not_measure_those_in_git_anew(monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_PROFILE", "smoke")
    with pytest.raises(InputError, match="embedded world"):
        timings.main()


def test_a_run_times_its_widths_and_the_tested_one_once(settings, small_world, monkeypatch):
    asked = {}

    def of_widths(sequences, source, widths):
        asked["widths"] = [len(each) for each in sequences], list(widths)
        return MEASURED

    def of_stages(sequence, model, width):
        asked["stages"] = len(sequence), model, width
        return MEASURED

    monkeypatch.setattr(timing, "seconds_of_widths", of_widths)
    monkeypatch.setattr(timing, "time_stages", of_stages)
    monkeypatch.setattr(timing.artefacts, "used_model", lambda: "the network")
    given = settings, [Sequence(small_world / "kitti", "00").subset(5)], None, 7
    timing.of_run(*given)
    measured = {"widths": ([3], [5, 7, 10]), "stages": (5, "the network", 7)}
    assert asked == measured
    asked.clear()
    timing.of_run(*given)
    assert asked == {}
    timing.of_run(*given, anew=True)
    assert asked == measured


def test_widths_are_timed_on_one_thread_and_on_all_cores(small_world, small_labels, monkeypatch):
    monkeypatch.setattr(timing, "cores", lambda: 2)
    monkeypatch.setattr(timing, "TURNS", 1)
    drive = Sequence(small_world / "kitti", "00").subset(4)
    seconds = timing.seconds_of_widths([drive], Source(small_labels), [5])
    runs = seconds[["method", "dilation_width", "threads"]].to_numpy().tolist()
    assert runs == [["baseline", 0, 1], ["baseline", 0, 2], ["masked", 5, 1], ["masked", 5, 2]]
    assert (seconds["seconds"] > 0).all()


def test_savings_are_equation_4_2_for_each_number_of_threads():
    rows = [("baseline", 0, 1, 10), ("masked", 5, 1, 8), ("baseline", 0, 2, 4), ("masked", 5, 2, 5)]
    seconds = pd.DataFrame(rows, columns=["method", "dilation_width", "threads", "seconds"])
    savings = timing.time_savings(seconds)
    assert savings.loc[5].to_dict() == {"1 thread": -20, "2 threads": 25}
