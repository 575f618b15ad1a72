"""Studies with masks of one's own: what is run, what is kept, and what is refused."""

import re
import shutil
import sys

import cv2
import numpy as np
import pandas as pd
import pytest
from evo.tools import file_interface

from thesis_repro.cli import main
from thesis_repro.kitti import Sequence
from thesis_repro.masks import LabelMasks
from thesis_repro.report import study as report
from thesis_repro.study import compare, controls, runner, series
from thesis_repro.study.sources import Source

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


@pytest.fixture(scope="module")
def study(small_world, small_labels, masks):
    planned = series.Study(
        small_world / "kitti", ("00", "01"), (Source(small_labels, name="net"), Source(masks, "masks", "by-hand")),
        (5, 7), tested=7, repetitions=2, frames=FRAMES)
    planned.check()
    return planned


@pytest.fixture(scope="module")
def done(study, tmp_path_factory):
    """(folder, runs) of the study."""
    folder = tmp_path_factory.mktemp("study") / "out"
    return folder, study.run(folder)


def files(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("[!.]*.csv")}


def test_masks_ready_made_are_what_label_maps_of_that_width_give(done):
    _, runs = done
    masked = runs[(runs["method"] == "masked") & (runs["dilation_width"] != 5)]
    net, by_hand = (masked.loc[masked["source"] == name, "rmse"].tolist() for name in ("net", "by-hand"))
    assert len(net) == 4 and net == by_hand
    # all keypoints are run once for both, and each source has controls of its own
    assert (runs["method"] == "baseline").sum() == 4 and set(runs.loc[runs["method"] == "baseline", "source"]) == {""}
    methods = {name: set(runs.loc[runs["source"] == name, "method"]) for name in ("net", "by-hand")}
    assert methods["net"] - methods["by-hand"] == set(controls.OF_LABEL_MAPS)
    assert {"mirrored", "other-frame", "random-lines", "image-edges", "fewer", "spread"} < methods["by-hand"]


def test_paths_are_read_by_evo_and_those_of_the_runs(done, study):
    folder, runs = done
    poses = runner.run_poses(runs[runs["repetition"] == 0], folder / "runs")
    files = {form: {str(path.relative_to(folder / "paths" / form).with_suffix("")): path
                    for path in (folder / "paths" / form).rglob("*.txt")} for form in ("kitti", "tum")}
    names = {f"{name}/{run}" for name, run in poses} | {"00/truth", "01/truth"}
    assert files["kitti"].keys() == files["tum"].keys() == names
    times = Sequence(study.kitti, "00").times[:FRAMES]
    for (name, run), expected in poses.items():
        of_kitti = file_interface.read_kitti_poses_file(files["kitti"][f"{name}/{run}"])
        assert np.array_equal(of_kitti.poses_se3, expected)
        of_tum = file_interface.read_tum_trajectory_file(files["tum"][f"{name}/{run}"])
        assert np.array_equal(of_tum.timestamps, times) and np.allclose(of_tum.poses_se3, expected, atol=1e-9)


def test_what_a_study_leaves_for_a_paper(done, study):
    folder, runs = done
    page = report.write(study, runs, folder)
    for name in ("comparison", "sources", "paths-00", "paths-01"):
        assert (folder / f"{name}.pdf").read_bytes().startswith(b"%PDF")
        assert {f"{name}.svg", f"{name}.webp"} & {path.name for path in folder.iterdir()}
    for name in ("comparison", "widths", "errors"):
        latex = (folder / f"{name}.tex").read_text()
        rows = pd.read_csv(folder / f"{name}.csv")
        body = latex.partition("\\midrule")[2].partition("\\bottomrule")[0]
        assert body.count("\\\\") == len(rows) and body.count("&") == len(rows) * (len(rows.columns) - 1)
        assert (folder / f"{name}.md").is_file()
    links = re.findall('(?:href|src)="([^"#]+)"', page.read_text())
    assert {"sources.webp", "paths-01.pdf", "errors.tex"} <= set(links)
    assert all((folder / link).is_file() for link in links)
    sources = report.figure_sources(study)
    assert len(sources.axes) == 3 * len(study.sources)
    for path in folder.glob("paths/*/01/net/masked-07-0.txt"):
        path.unlink()  # of a run that failed
    assert len(report.figure_paths(study, "01", folder).axes[0].lines) == 3  # all keypoints, by hand, and the truth


def test_the_same_again_runs_nothing_and_another_source_runs_only_its_own(done, study, small_labels, masks, tmp_path,
                                                                         monkeypatch):
    folder, runs = tmp_path / "out", done[1]
    shutil.copytree(done[0], folder)
    times = files(folder)
    with monkeypatch.context() as patch:
        patch.setattr(runner.odometry, "run_many", None)  # nothing may run
        again = study.run(folder)
    assert again.equals(runs) and again.attrs == {"made": 0, "kept": len(runs), "failed": 0}
    other = tmp_path / "other"
    shutil.copytree(small_labels, other)
    for path in other.rglob("*.png"):
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path), 0), 1))
    # another network of the same name
    replaced = series.Study(study.kitti, study.sequences, (Source(other, name="net"), study.sources[1]), study.widths,
                            tested=7, repetitions=2, frames=FRAMES)
    replaced.run(folder)
    changed = {path for path in times if not path.is_file() or path.stat().st_mtime_ns != times[path]}
    assert changed and {path.parent.name for path in changed} == {"net"}


def test_a_killed_study_goes_on_and_ends_as_an_undisturbed_one(done, study, small_world, small_labels, masks, tmp_path,
                                                               kill_when):
    folder = tmp_path / "out"
    command = [sys.executable, "-m", "thesis_repro", "study", "--kitti", small_world / "kitti",
               "--labels", small_labels, "--masks", masks, "--name", "net", "--name", "by-hand", "--widths", 5, 7,
               "--controls", 7, "--repetitions", 2, "--frames", FRAMES, "--estimator", "thesis", "--jobs", 2,
               "--output", folder]
    kill_when(command, lambda: files(folder))
    finished = files(folder)
    assert study.run(folder).equals(done[1])  # and so do one process and two
    assert finished == {path: path.stat().st_mtime_ns for path in finished}


def test_plain_folders_are_taken_for_a_single_sequence(small_world, small_labels, masks, tmp_path):
    single = series.Study(small_world / "kitti", ("00",), (Source(small_labels / "00", name="a"),
                                                           Source(masks / "00", "masks", "b")), (5,), frames=4)
    assert compare.sources(single.run(tmp_path / "out")) == ["a", "b"]


def test_results_of_another_length_are_not_thrown_away(done, study):
    before = files(done[0])
    shorter = series.Study(study.kitti, study.sequences, study.sources, study.widths, frames=5)
    with pytest.raises(series.InputError, match="other settings"):
        shorter.run(done[0])
    assert files(done[0]) == before


@pytest.mark.parametrize("given, names", [
    ([], "no masks: name a folder"),
    (["--labels", "nowhere"], "nowhere: no such folder; it must hold a folder of label maps for each sequence"),
    (["--labels", "LABELS", "--labels", "LABELS"], "two folders of masks would be called"),
    (["--labels", "LABELS", "--name", "a", "--name", "b"], "--name b: 2 names for 1 folders"),
    (["--labels", "LABELS", "--name", "a/b"], "--name a/b: a name may have letters"),
    (["--masks", "MASKS", "--widths", "5"], "--widths: only masks from label maps"),
    (["--masks", "MASKS", "--symmetric"], "--keep, --ids, --margin: need --labels DIR"),
    (["--masks", "LABELS"], "320x320 pixels, but the frames have"),
    (["--labels", "LABELS/00"], "holds the label maps of one sequence, but 2 are asked for"),
    (["--labels", "LESS", "--sequences", "00"], "(2 of 12 frames of sequence 00 have none)"),
    (["--labels", "LABELS", "--repetitions", "0"], "--repetitions 0: must be 1 or more"),
])
def test_bad_input_is_one_clear_line_before_anything_runs(small_world, small_labels, masks, tmp_path, capsys, given,
                                                          names):
    less = tmp_path / "LESS" / "00"
    shutil.copytree(small_labels / "00", less)
    for index in (3, 4):
        (less / f"{index:06d}.png").unlink()
    places = {"LABELS": small_labels, "MASKS": masks, "LESS": less.parent}
    given = [str(places[word.split("/")[0]] / word.partition("/")[2]) if word.split("/")[0] in places else word
             for word in given]
    assert main(["study", "--kitti", str(small_world / "kitti"), *given, "--output", str(tmp_path / "out")]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ") and names in error and "\n" not in error and not (tmp_path / "out").exists()
