"""Studies of a user's own masks: what they run, keep and refuse."""

import re
import shutil
import signal
from dataclasses import replace

import cv2
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import trials
from evo.tools import file_interface

from keypoint_study import runner
from keypoint_study.plan import Study
from keypoint_study.report import study_report as report
from keypoint_study.sources import Source
from thesis_repro.command.cli import main
from thesis_repro.data import label_ids
from thesis_repro.data.cityscapes import ID, TRAINED
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks.folders import LabelMasks, write_masks
from thesis_repro.running.files import write_png

FRAMES = 4


@pytest.fixture(scope="module")
def masks(small_world, small_labels, tmp_path_factory):
    """Ready-made masks of width 7, one folder a sequence."""
    root = tmp_path_factory.mktemp("ready")
    for name in ("00", "01"):
        write_masks(
            LabelMasks(small_labels / name, Sequence(small_world / "kitti", name), 7), root / name
        )
    return root


@pytest.fixture(scope="module")
def study(small_world, small_labels, masks):
    planned = Study(
        small_world / "kitti",
        ("00", "01"),
        (Source(small_labels, name="net"), Source(masks, "masks", "by-hand")),
        (5, 7),
        tested=7,
        repetitions=2,
        frames=FRAMES,
    )
    planned.check()
    return planned


@pytest.fixture(scope="module")
def done(study, tmp_path_factory):
    """(folder, runs) of the study."""
    folder = tmp_path_factory.mktemp("study") / "out"
    runs = study.run(folder).table
    report.write_paths(study, runs, folder)
    return folder, runs


def files(folder):
    return {path: path.stat().st_mtime_ns for path in (folder / "runs").rglob("[!.]*.csv")}


def test_ready_made_masks_give_the_errors_of_label_maps_of_that_width(done):
    _, runs = done
    masked = runs[(runs["method"] == "masked") & (runs["dilation_width"] != 5)]
    net, by_hand = (
        masked.loc[masked["source"] == name, "rmse"].tolist() for name in ("net", "by-hand")
    )
    assert len(net) == 4 and net == by_hand
    # the baseline is shared
    assert (runs["method"] == "baseline").sum() == 4 and set(
        runs.loc[runs["method"] == "baseline", "source"]
    ) == {""}


def test_evo_reads_the_written_paths(done, study):
    folder, runs = done
    poses = runner.run_poses(runs[runs["repetition"] == 0], folder / "runs")
    files = {
        form: {
            str(path.relative_to(folder / "paths" / form).with_suffix("")): path
            for path in (folder / "paths" / form).rglob("*.txt")
        }
        for form in ("kitti", "tum")
    }
    names = {f"{name}/{run}" for name, run in poses} | {"00/truth", "01/truth"}
    assert files["kitti"].keys() == files["tum"].keys() == names
    times = Sequence(study.kitti, "00").times[:FRAMES]
    for (name, run), expected in poses.items():
        assert np.array_equal(
            file_interface.read_kitti_poses_file(files["kitti"][f"{name}/{run}"]).poses_se3,
            expected,
        )
        tum = file_interface.read_tum_trajectory_file(files["tum"][f"{name}/{run}"])
        assert np.array_equal(tum.timestamps, times) and np.allclose(
            tum.poses_se3, expected, atol=1e-9
        )


def test_figures_and_tables_of_a_study(done, study, monkeypatch):
    folder, runs = done
    written, drawn, figures_of = ("comparison-net", "sources", "paths-01"), set(), report.figures_of

    def one_of_a_kind(*given):  # is written, which takes longest
        for figure in figures_of(*given):
            drawn.add(figure.name)
            if figure.name in written:
                yield figure
            else:
                plt.close(figure.content)

    monkeypatch.setattr(report, "figures_of", one_of_a_kind)
    page = report.write(study, runs, folder)
    names = {path.name for path in folder.iterdir()}
    # the controls of each source have a figure of their own
    assert drawn == {"comparison", "comparison-by-hand", "paths-00", *written}
    for name in written:
        assert {f"{name}.svg", f"{name}.webp"} & names
        for end in (".pdf", "-column.pdf"):
            content = (folder / f"{name}{end}").read_bytes()
            assert b"/Type3" not in content and b"/FontFile2" in content  # TrueType
            width = float(re.search(rb"/MediaBox \[ 0 0 ([\d.]+)", content)[1])
            assert (width == 3.5 * 72) == (end == "-column.pdf")
    tables = {"errors.csv", "errors.md", "widths.csv", "ratios.csv", "runs.csv"}
    assert tables <= names and not {"ratios.md", "runs.md"} & names
    ratios = pd.read_csv(folder / "ratios.csv")
    keys = ["source", "label", "reference_source", "reference", "metric", "estimator"]
    assert not ratios.duplicated(keys).any()
    captions = re.findall("<figcaption><p><strong>.*?</strong>(.*?)</p>", page.read_text(), re.S)
    assert len(captions) > 6 and all(len(caption.split()) > 3 for caption in captions)
    links = re.findall('(?:href|src)="([^"#]+)"', page.read_text())
    assert {"sources.webp", "paths-01.pdf", "errors.csv", "runs.csv"} <= set(links)
    assert all((folder / link).is_file() for link in links)
    assert len(report.figure_of_sources(study, runs).content.axes) == 3 * len(study.sources)
    failed = (runs["sequence"] == "01") & (runs["source"] == "net")
    figure = report.figure_of_sequence(study, runs[~failed], study.opened[1], folder).content
    assert len(figure.axes[0].lines) == 3  # all keypoints, by hand, ground truth


def test_a_repeated_study_runs_nothing_and_another_source_only_its_runs(
    done, study, small_labels, tmp_path, monkeypatch
):
    folder, runs = tmp_path / "out", done[1]
    shutil.copytree(done[0], folder)
    times = files(folder)
    with monkeypatch.context() as patch:
        patch.setattr(runner.odometry, "run_many", None)  # would fail
        again = study.run(folder)
    assert again.table.equals(runs)
    assert (again.made, again.kept, len(again.reasons)) == (0, len(runs), 0)
    other = tmp_path / "other"
    shutil.copytree(small_labels, other)
    for path in other.rglob("*.png"):
        cv2.imwrite(str(path), cv2.flip(cv2.imread(str(path), 0), 1))
    # another network of this name
    replace(study, sources=(Source(other, name="net"), study.sources[1])).run(folder)
    changed = {
        path for path in times if not path.is_file() or path.stat().st_mtime_ns != times[path]
    }
    assert changed and {path.parent.name for path in changed} == {"net"}


@pytest.mark.torture
def test_a_killed_study_resumes_and_ends_as_an_undisturbed_one(
    done, study, small_world, small_labels, masks, tmp_path
):
    folder = tmp_path / "out"
    sources = ["--labels", f"net={small_labels}", "--masks", f"by-hand={masks}"]
    sizes = ["--widths", 5, 7, "--controls", 7, "--repetitions", 2, "--frames", FRAMES]
    words = ["study", "--kitti", small_world / "kitti", *sources, *sizes, "--estimator", "thesis"]
    process = trials.start(trials.thesis(*words, "--jobs", 1, "--output", folder), trials.ROOT)
    trials.wait_for(lambda: process.poll() is not None or files(folder), 600)
    trials.kill(process)
    assert process.returncode == -signal.SIGKILL
    finished = files(folder)
    assert study.run(folder).table.equals(done[1])
    assert finished == {path: path.stat().st_mtime_ns for path in finished}


def test_each_folder_of_label_maps_may_name_its_ids(
    small_world, small_labels, tmp_path, monkeypatch
):
    monkeypatch.setattr(report, "figures_of", lambda *_: ())
    numbers = np.full(256, 255, np.uint8)  # train ids, by label id
    numbers[[ID[name] for name in TRAINED]] = range(len(TRAINED))
    for path in sorted((small_labels / "00").glob("*.png")):
        train_ids = numbers[cv2.imread(str(path), cv2.IMREAD_UNCHANGED)]
        write_png(tmp_path / "train" / "00" / path.name, train_ids)
        label_map = label_ids.read(tmp_path / "train" / "00" / path.name, "train")
        write_png(tmp_path / "7:00" / "00" / path.name, label_map)
    where = ["--kitti", small_world / "kitti", "--sequences", "00", "--frames", 4]
    sources = ["--labels", f"mine={tmp_path / 'train'}:train", "--labels", tmp_path / "7:00"]
    counts = ["--widths", 5, "--repetitions", 1, "--estimator", "thesis", "--jobs", 1]
    words = [*where, *sources, *counts, "--output", tmp_path / "out"]
    assert main(["study", *map(str, words)]) == 0
    runs = pd.read_csv(tmp_path / "out" / "runs.csv", keep_default_na=False).set_index("source")
    assert list(runs.index) == ["", "mine", "7-00"]
    assert (tmp_path / "out/index.html").is_file()
    assert runs.loc["mine", "rmse"] == runs.loc["7-00", "rmse"] != runs.loc["", "rmse"]


@pytest.fixture
def brought(study, tmp_path):
    """A study of own keypoints, which are all keypoints."""
    (tmp_path / "mine.py").write_text("from thesis_repro.odometry.loop import detect\n")
    sources = (Source(tmp_path / "mine.py", "keypoints", "mine"),)
    return replace(study, sequences=("00",), sources=sources, widths=(), tested=None)


def test_own_keypoints_are_rows_as_masks_are(brought, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "figures_of", lambda *_: ())
    brought.check()
    runs = brought.run(tmp_path / "out").table
    keys = ["sequence", "repetition"]
    of_all, mine = (runs[runs["source"] == name].set_index(keys) for name in ("", "mine"))
    numbers = ["rmse", "se3", "rotation", "mean_keypoints"]
    assert mine[numbers].equals(of_all[numbers]) and len(mine) == 2
    report.write(brought, runs, tmp_path / "out")
    ratios = pd.read_csv(tmp_path / "out" / "ratios.csv").query("method != 'baseline'")
    assert list(ratios["label"].unique()) == ["mine"]
    errors = pd.read_csv(tmp_path / "out" / "errors.csv")
    assert list(errors["method"]) == ["all keypoints", "mine"] * 2
    times = files(tmp_path / "out")
    path = tmp_path / "mine.py"
    path.write_text(path.read_text() + "# edited\n")
    again = brought.run(tmp_path / "out")
    changed = {path for path, time in times.items() if path.stat().st_mtime_ns != time}
    assert (again.made, again.kept) == (2, len(runs) - 2) and len(changed) == 2
    assert again.table["se3"].equals(runs["se3"])


def test_results_of_another_length_are_kept(done, study):
    before = files(done[0])
    with pytest.raises(InputError, match="other settings"):
        replace(study, frames=5).run(done[0])
    assert files(done[0]) == before


@pytest.mark.parametrize(
    "options, named",
    [
        ("", "--labels"),
        ("--labels nowhere", "nowhere: "),
        ("--labels nowhere:train", "nowhere: "),
        ("--keypoints none.py", "none.py"),
        ("--masks a=nowhere --labels a={labels}", "'a'"),
        ("--labels {labels}:none.csv", "none.csv: "),
        ("--labels {labels} --labels {labels}", "small_labels"),
        ("--labels a={labels} --masks A={masks}", "'A'"),
        ("--labels a*b={labels}", "--labels a*b="),
        ("--labels ={labels}", "--labels ="),
        ("--labels a/b={labels}", "a/b="),
        ("--masks {masks} --widths 5", "--widths: "),
        ("--masks {masks} --symmetric", "--labels"),
        ("--masks {labels}", "320x320"),
        ("--labels {labels}/00", "2 are asked for"),
        ("--labels {less} --sequences 00", "2 of 12 frames of sequence 00"),
        ("--labels {labels} --controls -1", "dilation width -1: "),
    ],
)
def test_bad_input_is_one_line_before_anything_runs(
    small_world, small_labels, masks, tmp_path, capsys, options, named
):
    less = tmp_path / "less"
    shutil.copytree(small_labels / "00", less / "00")
    for index in (3, 4):
        (less / "00" / f"{index:06d}.png").unlink()
    words = options.format(labels=small_labels, masks=masks, less=less).split()
    assert (
        main(
            [
                "study",
                "--kitti",
                str(small_world / "kitti"),
                *words,
                "--output",
                str(tmp_path / "out"),
            ]
        )
        == 1
    )
    error = capsys.readouterr().err.strip()
    assert (
        error.startswith("error: ")
        and named in error
        and "\n" not in error
        and not (tmp_path / "out").exists()
    )


def test_a_study_without_any_masked_run_is_one_clear_line(small_world, small_labels, tmp_path):
    shutil.copytree(small_labels / "00", tmp_path / "labels" / "00")
    damaged = tmp_path / "labels" / "00" / "000002.png"
    damaged.write_bytes(damaged.read_bytes()[:-20])
    study = Study(
        small_world / "kitti", ("00",), (Source(tmp_path / "labels", name="net"),), (5,), frames=5
    )
    with pytest.raises(InputError, match="every run but those with all keypoints failed"):
        study.run(tmp_path / "out")


def test_a_study_without_true_poses_is_one_line(small_world, masks, tmp_path, capsys):
    folder = tmp_path / "kitti" / "sequences" / "00"
    folder.parent.mkdir(parents=True)
    folder.symlink_to(small_world / "kitti" / "sequences" / "00")
    words = ["--kitti", tmp_path / "kitti", "--output", tmp_path / "out", "--masks", masks]
    assert main(["study", *map(str, words)]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.fullmatch(r"error: .*00.txt: no such file; a study needs true poses.*", line)
    assert not (tmp_path / "out").exists()
