"""Studies with masks of one's own, through the command line."""

import os
import shutil
import signal
import subprocess
import sys
import time
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro.cli import main
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks
from thesis_repro.study import results, runner, series
from thesis_repro.study.sources import Source

ROOT = Path(__file__).resolve().parents[2]
FRAMES = 6


@pytest.fixture(scope="module")
def masks(small_world, small_labels, tmp_path_factory):
    """Masks of width 7 of the frames' size, one folder a sequence."""
    root = tmp_path_factory.mktemp("ready")
    for name in ("00", "01"):
        sequence = Sequence(small_world / "kitti", name)
        made = LabelMasks(small_labels / name, sequence, 7)
        (root / name).mkdir()
        for index, path in enumerate(sequence.frame_paths):
            cv2.imwrite(str(root / name / path.name), made[index])
    return root


def study(*options):
    return main(["study", *map(str, options)])


def options(small_world, small_labels, masks, output):
    return ["--kitti", small_world / "kitti", "--labels", small_labels, "--masks", masks, "--name", "net", "--name",
            "by-hand", "--widths", 5, 7, "--controls", 7, "--repetitions", 2, "--frames", FRAMES, "--output", output]


class Links(HTMLParser):
    def __init__(self, text):
        super().__init__()
        self.found = []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.found += [value for key, value in attributes if key in ("href", "src")]


def tables(folder):
    return {path.name: path.read_text() for path in folder.glob("*.csv")}


@pytest.fixture(scope="module")
def done(small_world, small_labels, masks, tmp_path_factory):
    """The folder of a study with both sources."""
    folder = tmp_path_factory.mktemp("study") / "out"
    assert study(*options(small_world, small_labels, masks, folder), "--jobs", 1) == 0
    return folder


def test_a_study_leaves_tables_figures_words_and_a_page_that_shows_them(done):
    page = (done / "index.html").read_text()
    links = [link for link in Links(page).found if not link.startswith("#")]
    assert all((done / link).is_file() for link in links)
    assert {path.name for path in done.iterdir() if path.is_file()} - {
        "index.html", "made-from.json", "log.txt", "runs.csv", "runs.md", "findings.md"} <= {*links}
    assert {"comparison.svg", "comparison_keypoints.svg", "comparison_sequences.svg", "comparison.csv", "widths.md",
            "errors.csv"} <= {*links}
    assert "embedded world" in page and "script" not in page
    words = (done / "findings.md").read_text()
    assert "**net.**" in words and "**by-hand.**" in words and "by-hand over net" in words and "nan" not in words


def test_masks_ready_made_are_what_label_maps_of_that_width_give(done, small_world):
    runs = pd.read_csv(done / "runs.csv", dtype={"sequence": str}, keep_default_na=False)
    by_hand, net = (runs[(runs["source"] == name) & (runs["method"] == "masked")
                         & runs["dilation_width"].isin(["", "7.0"])] for name in ("by-hand", "net"))
    assert len(net) == 4 and net["rmse"].tolist() == by_hand["rmse"].tolist()
    # all keypoints are run once for both, and each source has controls of its own
    assert (runs["method"] == "baseline").sum() == 4 and set(runs.loc[runs["method"] == "baseline", "source"]) == {""}
    methods = {name: set(runs.loc[runs["source"] == name, "method"]) for name in ("net", "by-hand")}
    assert methods["net"] - methods["by-hand"] == {"exact-boundaries", "corrected", "true-labels"}
    assert {"mirrored", "other-frame", "random-lines", "image-edges", "fewer", "spread"} < methods["by-hand"]
    table = pd.read_csv(done / "comparison.csv")
    table = table[(table["over"] == "all keypoints") & table["keypoints"].str.contains("segmentation mask")]
    assert set(table["keypoints"]) == {"net: segmentation mask, width 7", "by-hand: segmentation mask"}
    assert table.groupby("estimator")["RMSE"].nunique().eq(1).all()


def test_the_same_again_runs_nothing_and_another_source_runs_only_its_own(done, small_world, small_labels, masks,
                                                                         tmp_path, monkeypatch):
    folder = tmp_path / "out"
    shutil.copytree(done, folder)
    times = {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("*.csv")}
    given = options(small_world, small_labels, masks, folder)
    monkeypatch.setattr(runner.odometry, "run_many", None)  # nothing may run
    assert study(*given, "--jobs", 1) == 0 and tables(folder) == tables(done)
    monkeypatch.undo()
    other = tmp_path / "other"
    shutil.copytree(small_labels, other)
    for path in other.rglob("*.png"):
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path), 0), 1))
    given[3] = other  # another network of the same name
    assert study(*given, "--jobs", 1) == 0
    changed = {path for path in times if not path.is_file() or path.stat().st_mtime_ns != times[path]}
    assert changed and {path.parent.name for path in changed} == {"net"}


def test_a_killed_study_goes_on_and_ends_as_an_undisturbed_one(done, small_world, small_labels, masks, tmp_path):
    given = options(small_world, small_labels, masks, tmp_path / "out")
    command = [sys.executable, "-m", "thesis_repro", "study", *map(str, given), "--jobs", "2"]
    process = subprocess.Popen(command, env=os.environ | {"PYTHONPATH": str(ROOT)}, stderr=subprocess.DEVNULL,
                               start_new_session=True)
    end = time.monotonic() + 600
    while not list((tmp_path / "out" / "runs").rglob("*.csv")):
        assert time.monotonic() < end and process.poll() is None
        time.sleep(0.05)
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not (tmp_path / "out" / "index.html").exists()
    finished = {path: path.stat().st_mtime_ns for path in (tmp_path / "out" / "runs").rglob("*.csv")}
    assert study(*given, "--jobs", 1) == 0
    assert finished == {path: path.stat().st_mtime_ns for path in finished}
    assert tables(tmp_path / "out") == tables(done)  # and so do one process and two


def test_plain_folders_are_taken_for_a_single_sequence(small_world, small_labels, masks, tmp_path):
    kitti = small_world / "kitti"
    for asked, fine in ((["00"], True), (["00", "01"], False)):
        given = series.Study(kitti, tuple(asked), (Source(small_labels / "00", name="a"),
                                                   Source(masks / "00", "masks", "b")), (5,), frames=4)
        if fine:
            summary = series.checked(given).run(tmp_path / "out")
            assert results.sources(summary) == ["a", "b"]
        else:
            with pytest.raises(series.InputError, match="holds the label maps of one sequence, but 2 are asked for"):
                series.checked(given)


def test_one_estimator_is_enough(small_world, small_labels, tmp_path):
    assert study("--kitti", small_world / "kitti", "--sequences", "00", "--labels", small_labels, "--widths", 5,
                 "--repetitions", 1, "--frames", 5, "--estimator", "refined", "--margin", 30, "--jobs", 1, "--output",
                 tmp_path / "out") == 0
    words = (tmp_path / "out" / "findings.md").read_text()
    assert "refined estimator" in words and "(label maps; margin 30)" in words
    assert set(pd.read_csv(tmp_path / "out" / "runs.csv")["estimator"]) == {"refined"}
    assert not (tmp_path / "out" / "widths.csv").exists()


@pytest.mark.parametrize("given, says", [
    ([], "no masks: name a folder"),
    (["--labels", "nowhere"], "nowhere: no such folder; it must hold a folder of label maps for each sequence"),
    (["--labels", "LABELS", "--labels", "LABELS"], "two folders of masks would be called"),
    (["--labels", "LABELS", "--name", "a", "--name", "b"], "--name b: 2 names for 1 folders"),
    (["--labels", "LABELS", "--name", "a/b"], "--name a/b: a name may have letters"),
    (["--masks", "MASKS", "--widths", "5"], "--widths: only masks from label maps"),
    (["--masks", "MASKS", "--symmetric"], "--symmetric, --classes, --without-movable, --margin: need --labels DIR"),
    (["--labels", "LABELS", "--margin", "-1"], "margin=-1: must be 0 or more pixels"),
    (["--masks", "LABELS"], "320x320 pixels, but the frames have"),
    (["--masks", "TRUE", "--sequences", "00"], "different values; a mask has 0 and 255 (label maps go with --labels)"),
    (["--labels", "LABELS", "--sequences", "77"], "77/image_0: no such folder"),
    (["--labels", "LABELS/00"], "holds the label maps of one sequence, but 2 are asked for"),
    (["--labels", "LESS", "--sequences", "00"], "(2 of 12 frames of sequence 00 have none)"),
    (["--labels", "LESS", "--sequences", "01"], "LESS/01: no such folder"),
    (["--labels", "LABELS", "--widths", "0"], "--widths 0: must be 1 or more"),
    (["--labels", "LABELS", "--repetitions", "0"], "--repetitions 0: must be 1 or more"),
    (["--labels", "LABELS", "--frames", "2"], "--frames 2: must be 3 or more"),
    (["--labels", "LABELS", "--jobs", "0"], "--jobs 0: must be 1 or more"),
])
def test_bad_input_is_one_clear_line_before_anything_runs(small_world, small_labels, masks, tmp_path, capsys, given,
                                                          says):
    less = tmp_path / "LESS" / "00"
    shutil.copytree(small_labels / "00", less)
    for index in (3, 4):
        (less / f"{index:06d}.png").unlink()
    places = {"LABELS": small_labels, "MASKS": masks, "LESS": less.parent,
              "TRUE": small_world / "kitti/sequences/00/labels_0"}
    given = [str(places[word.split("/")[0]] / word.partition("/")[2]) if word.split("/")[0] in places else word
             for word in given]
    assert study("--kitti", small_world / "kitti", *given, "--output", tmp_path / "out") == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ") and says in error and "\n" not in error and not (tmp_path / "out").exists()


def test_results_of_another_length_are_not_thrown_away(done, small_world, small_labels, masks, capsys):
    before = tables(done)
    shorter = [5 if word == FRAMES else word for word in options(small_world, small_labels, masks, done)]
    assert study(*shorter) == 1
    assert "holds results of other settings (frames 6, not 5)" in capsys.readouterr().err and tables(done) == before


def test_a_mask_that_breaks_in_the_middle_costs_only_the_runs_that_need_it(small_world, masks, tmp_path, capsys):
    shutil.copytree(masks, tmp_path / "ready")
    broken = tmp_path / "ready" / "00" / "000003.png"
    data = bytearray(broken.read_bytes())
    data[len(data) // 2] ^= 1
    broken.write_bytes(data)
    given = series.Study(small_world / "kitti", ("00",), (Source(tmp_path / "ready", "masks", "ready"),), (), frames=5)
    summary = series.checked(given).run(tmp_path / "out")
    assert summary["run"].tolist() == ["baseline-0"]
    assert f"sequence 00, ready/masked-0: failed: {broken}: the image is truncated" in capsys.readouterr().out


def test_errors_side_by_side_are_those_of_the_runs():
    rows = [{"sequence": name, "source": source, "method": "masked" if source else "baseline", "dilation_width": width,
             "estimator": "thesis", "repetition": repetition, "frames": 9, "flagged": 0, "mean_keypoints": count,
             "rmse": error * (1 + repetition), "mae": error, "se3": error / 2, "translation_percent": np.nan,
             "rotation_deg_per_m": np.nan}
            for name, factor in (("00", 1), ("01", 3)) for source, width, count, error in
            (("", np.nan, 2000, 1.0 * factor), ("b", 5, 500, 0.5 * factor), ("a", np.nan, 1000, 2.0))
            for repetition in (0, 1)]
    summary = pd.DataFrame(rows)
    table = results.side_by_side(summary).set_index("source")
    assert table.index.tolist() == ["", "b", "a"]  # in the order of the runs
    assert table.loc["b", "rmse_change"] == -50 and table.loc["b", "rmse_improved"] == 2
    assert table.loc["b", "kept"] == 25
    assert table.loc["b", "se3_change"] == -50 and np.isnan(table.loc["b", "translation_percent_change"])
    assert table.loc["a", "mae_change"] == pytest.approx((100 - 100 / 3) / 2) and np.isnan(table.loc["a", "rmse_low"])
    errors = results.errors(summary).set_index(["source", "sequence"])
    assert errors.loc[("b", "01"), ["rmse", "rmse_lowest", "rmse_highest"]].tolist() == [2.25, 1.5, 3.0]
