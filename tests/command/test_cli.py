"""The ways in: the command line and the public names."""

import json
import re
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest
import trials

import thesis_repro as tr
import write_texts
from keypoint_study import sources
from thesis_repro.command import cli
from thesis_repro.command.options import build_parser
from thesis_repro.data import cityscapes
from thesis_repro.data.trajectories import read_poses
from thesis_repro.masks.kinds import KINDS, Kind
from thesis_repro.odometry.estimators import COMPARED, ESTIMATORS, Entry
from thesis_repro.odometry.keypoints import DETECTORS
from thesis_repro.running import program, provenance
from thesis_repro.running.files import write_png


def run(command, *words):
    return cli.main([command, *map(str, words)])


PARSER = build_parser(cli.COMMANDS)
COMMANDS = write_texts.commands()


def test_a_source_given_as_a_link_keeps_the_typed_name(tmp_path):
    (tmp_path / "run 17").mkdir()
    (tmp_path / "my-net").symlink_to(tmp_path / "run 17")
    words = ["study", "--kitti", "kitti", "--output", "out", "--labels", f"{tmp_path}/my-net"]
    given = PARSER.parse_args([*words, "--labels", f"{tmp_path}/run 17"]).sources
    assert [each.name for each in sources.named(given, None)] == ["my-net", "run-17"]


def test_the_console_script_prints_the_version():
    script = Path(sys.executable).with_name("thesis-repro")
    assert script.is_file(), "install the package: make setup"
    outputs = [
        subprocess.run([*command, "--version"], capture_output=True, text=True, check=True).stdout
        for command in ([script], [sys.executable, "-m", "thesis_repro"])
    ]
    assert outputs[0] == outputs[1] == f"thesis-repro {metadata.version('thesis-repro')}\n"


@pytest.mark.parametrize(
    "module, name, advice",
    [
        ("cv2", "run", "opencv-python-headless"),
        ("keras", "build_unet((32, 32, 1), 35)", 'pip install "thesis-repro[segmentation]"'),
    ],
)
def test_a_missing_package_is_named_in_one_line(module, name, advice):
    program = (
        f"import sys; sys.modules[{module!r}] = None; import thesis_repro; thesis_repro.{name}"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    *_, line = result.stderr.splitlines()
    assert re.match(r"AttributeError: |thesis_repro.errors.InputError: ", line) and advice in line


ODOMETRY = "odometry --kitti kitti --sequence 00"
STUDY = "study --kitti kitti --labels labels --output out"


@pytest.mark.parametrize(
    "path, says, words, cure",
    [
        ("cv2.py", "'libGL.so.1: cannot open it', name='cv2'", ODOMETRY, "opencv-python-headless"),
        ("cv2.py", "'libGL.so.1: cannot open it', name='cv2'", "study --help", "python-headless"),
        ("cv2/__init__.py", "'OpenCV loader: no configuration'", ODOMETRY, "python-headless"),
        ("numpy/__init__.py", "'no\\nC extensions'", ODOMETRY, "numpy"),
        ("keypoint_study.py", "name=__name__", STUDY, '"thesis-repro"'),
        ("keypoint_study.py", "name=__name__", f"{ODOMETRY} --plot a.png", '"thesis-repro"'),
    ],
)
def test_a_broken_package_is_told_with_its_file_and_cure(path, says, words, cure, tmp_path):
    """It stands on PYTHONPATH, as one of another Python does."""
    (tmp_path / path).parent.mkdir(exist_ok=True)
    (tmp_path / path).write_text(f"raise ImportError({says})")
    places = f"{tmp_path}:{trials.ROOT}"
    result = trials.run(trials.thesis(*words.split()), tmp_path, PYTHONPATH=places)
    trials.refused(result, cure, left=["*__pycache__*"])
    assert str(tmp_path / path) in result.stderr or "keypoint_study" in path


def test_a_package_whose_files_were_removed_is_told():
    with pytest.raises(AttributeError) as caught:
        _ = ModuleType("cv2").imread
    assert cv2.__file__ in program.explain(caught.value)
    with pytest.raises(AttributeError) as caught:
        _ = cv2.no_such_name
    assert program.explain(caught.value) is None


def test_a_copied_environment_is_told(tmp_path, monkeypatch, capsys):
    (tmp_path / "bin").mkdir()
    (tmp_path / "pyvenv.cfg").touch()
    monkeypatch.setattr(sys, "argv", [str(tmp_path / "bin/thesis-repro"), "--version"])
    assert cli.main() == 1
    line = capsys.readouterr().err
    assert str(tmp_path) in line and "make clean" in line and line.count("\n") == 1


def test_a_path_begins_at_home_where_no_shell_replaces_it(monkeypatch):
    monkeypatch.setenv("HOME", "/home/me")
    words = ["study", "--kitti=~/k", "--labels=~/l", "--masks", "n=~/m", "--output=~/o"]
    options = PARSER.parse_args(words)
    folders = [options.kitti, options.folder, *(folder for _, _, folder in options.sources)]
    assert list(map(str, folders)) == [f"/home/me/{letter}" for letter in "kolm"]


def test_a_shell_completes_commands_options_and_files(capsys):
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--print-completion", "bash"])
    script = capsys.readouterr().out
    for word in ("_repro_study_option_strings", "--spread", "_predict___images_COMPGEN"):
        assert word in script


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_shows_two_valid_examples(name):
    examples = [shlex.split(line) for line in COMMANDS[name].epilog.splitlines()[1:]]
    assert [PARSER.parse_args(words).command for _, *words in examples] == [name, name]


def test_written_masks_give_the_same_path_as_label_maps(small_world, small_labels, tmp_path):
    where = ["--kitti", small_world / "kitti", "--sequence", "00", "--frames", 6]
    labels = ["--labels", small_labels / "00", "--dilation"]
    corrected = "--boundaries exact --symmetric --without-movable --classes road --margin 4"
    paths = []
    for name, options in (("thesis", []), ("corrected", corrected.split())):
        masks, one, two = tmp_path / name, tmp_path / "masks.txt", tmp_path / "labels.txt"
        assert run("masks", *where, *labels, 5, *options, "--output", masks) == 0
        assert run("odometry", *where, "--masks", masks, "--output", one) == 0
        assert run("odometry", *where, *labels, 5, *options, "--output", two) == 0
        assert one.read_bytes() == two.read_bytes()
        paths.append(one.read_bytes())
    assert len(set(paths)) == len(paths)


def test_the_odometry_writes_poses_and_prints_a_summary(small_world, tmp_path, capsys):
    poses, tum = tmp_path / "poses.txt", tmp_path / "path.tum"
    where = ["--kitti", small_world / "kitti", "--sequence", "00", "--frames", 8, "--json"]
    assert run("odometry", *where, "--output", poses, "--tum", tum) == 0
    out, err = capsys.readouterr()
    summary = json.loads(out)
    assert summary["frames"] == len(read_poses(poses)) == 8 and summary["rmse_m"] > 0
    assert str(poses) in err and str(tum) in err
    assert len(tum.read_text().splitlines()) == 8


@pytest.mark.parametrize("options", [["--plot", "path.png"], ["--speed", "7"]])
def test_without_ground_truth_there_are_no_errors(
    tiny_kitti, options, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tiny_kitti / "poses/00.txt").unlink()
    assert run("odometry", "--kitti", tiny_kitti, "--sequence", "0", "--json", *options) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["rmse_m"] is None and summary["mae_m"] is None
    assert (cv2.imread("path.png") is not None) == ("--plot" in options)


@pytest.mark.slow
def test_public_names():
    assert dir(tr) == sorted([*tr.__all__, "__version__"])
    assert all(hasattr(tr, name) for name in tr.__all__) and not hasattr(tr, "mistyped")
    assert tr.__version__ == metadata.version("thesis-repro")
    assert (
        tr.OdometrySettings() == tr.THESIS
        and tr.Sequence.__module__ == "thesis_repro.data.sequence"
    )
    assert tr.keypoint_mask(np.full((8, 8), 7, np.uint8), (16, 32), 3).shape == (16, 32)
    assert tr.build_unet((32, 32, 1), 35, 2).output_shape == (None, 32, 32, 35)


def test_tensorflow_is_not_loaded_before_it_is_used():
    names = "pydoc.render_doc(tr), pydoc.render_doc(tr.Step), tr.build_unet, tr.metrics, tr.run"
    code = f"import pydoc, sys, thesis_repro as tr; {names}; assert not {{'tensorflow', 'keras'}} & {{*sys.modules}}"
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


CAMERA = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
MAP, FRAME = np.full((8, 8), 7, np.uint8), np.eye(96, 128, dtype=np.uint8)


def test_options_of_the_odometry(tiny_kitti, tmp_path, capsys):
    (tiny_kitti / "poses/00.txt").rename(tmp_path / "truth.txt")
    (tmp_path / "camera.txt").write_text("50 50 32 24 -0.3 0.1 0 0")
    where = ["--kitti", tiny_kitti, "--sequence", "00", "--json", "--scale-gate"]
    summaries = []
    for options in (
        [0],
        [0, "--truth", tmp_path / "truth.txt"],
        [0, "--spread", 20],
        [0, "--max-keypoints", 20],
        [0, "--calibration", tmp_path / "camera.txt"],
        [2],
    ):
        assert run("odometry", *where, *options) == 0
        out, err = capsys.readouterr()
        assert ("4 of 4 steps" in err or "3 of 4 steps" in err) == (options == [2])
        summaries.append(json.loads(out))
    plain, true, spread, strongest, undistorted, _ = summaries
    assert plain["rmse_m"] is None and true["rmse_m"] > 0
    assert 10 < spread["mean_keypoints"] <= 20 < plain["mean_keypoints"]
    assert strongest["mean_keypoints"] == 20
    assert undistorted["mean_keypoints"] != plain["mean_keypoints"]
    assert run("odometry", *where, 0, "--fill", 5) == 1  # there is no mask to fill
    assert "--fill" in capsys.readouterr().err


def test_label_maps_in_other_ids_give_the_same_masks(tiny_kitti, tmp_path):
    labels = np.repeat([[23], [7]], 24, axis=0).repeat(64, axis=1).astype(np.uint8)
    (tmp_path / "ids.csv").write_text("2,sky\n300,road\n")
    numbers = np.where(labels == 7, 300, 2).astype(np.uint16)
    colours = cityscapes.colorize(labels)[..., ::-1]
    made = []
    for ids, picture in (("labels", labels), ("colors", colours), (tmp_path / "ids.csv", numbers)):
        for index in range(4):
            write_png(tmp_path / f"maps/{index:06d}.png", picture)
        maps = ["--labels", tmp_path / "maps", "--dilation", 3]
        where = ["--kitti", tiny_kitti, "--sequence", "00", *maps]
        assert run("masks", *where, "--ids", ids, "--output", tmp_path / "masks") == 0
        made.append((tmp_path / "masks/000002.png").read_bytes())
    assert made[0] == made[1] == made[2]
    assert "table" in provenance.record(tmp_path / "masks")


def test_a_new_kind_of_mask_is_one_entry(monkeypatch, tiny_kitti, tmp_path):
    def left(label_map, size, dilation_width, settings):
        mask = np.zeros(size, np.uint8)
        mask[:, : size[1] // 2] = 255
        return mask

    monkeypatch.setitem(KINDS, "left", Kind(left, "on the left", has_width=False))
    assert "on the left" in write_texts.commands()["study"].format_help()
    for index in range(4):
        write_png(tmp_path / f"maps/{index:06d}.png", MAP)
    where = ["--kitti", tiny_kitti, "--sequence", "00", "--labels", tmp_path / "maps"]
    assert run("masks", *where, "--keep", "left", "--output", tmp_path / "masks") == 0
    mask = cv2.imread(str(tmp_path / "masks/000002.png"), cv2.IMREAD_UNCHANGED)
    assert mask[:, : mask.shape[1] // 2].all() and not mask[:, mask.shape[1] // 2 :].any()


def test_a_new_detector_is_a_name_and_an_option(tiny_kitti, monkeypatch, capsys):
    def mine(frame, settings, mask=None):
        """Seven points, 50 % of which are mine."""
        return np.full((7, 2), 9, np.float32)

    monkeypatch.setitem(DETECTORS, "mine", mine)
    assert tr.mine is mine
    where = ["--kitti", tiny_kitti, "--sequence", "00", "--json"]
    for name, count in {"mine": 7, "spread=5": 5}.items():
        assert run("odometry", *where, "--detector", name) == 0
        assert json.loads(capsys.readouterr().out)["mean_keypoints"] == count
    for wrong in ("hers", "spread", "mine=5", "spread=0"):
        with pytest.raises(SystemExit):
            run("odometry", *where, "--detector", wrong)
        assert "--detector" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        run("odometry", "--help")
    assert "mine: Seven points, 50 % of which" in " ".join(capsys.readouterr().out.split())


def test_a_new_estimator_runs_in_a_study_only_if_it_is_asked_for(monkeypatch):
    monkeypatch.setitem(ESTIMATORS, "mine", Entry("my estimator", None))
    parser = build_parser(cli.COMMANDS, ["study"])
    words = ["study", "--kitti", "kitti", "--labels", "mine", "--output", "out"]
    assert parser.parse_args(words).estimator == list(COMPARED) == ["thesis", "refined"]
    assert parser.parse_args([*words, "--estimator", "mine"]).estimator == ["mine"]


@pytest.mark.parametrize(
    "call, named",
    [
        (lambda: tr.keypoint_mask(np.zeros((8, 8, 35), np.uint8), (16, 32), 3), "label map"),
        (lambda: tr.keypoint_mask(MAP + 30, (16, 32), 3), "label map"),
        (lambda: tr.Odometry(CAMERA.T), "intrinsics"),
        (lambda: tr.Odometry(-CAMERA), "intrinsics"),
        (lambda: tr.Odometry(np.eye(3)).step(FRAME), "intrinsics"),
        (lambda: tr.Odometry(CAMERA, [MAP]), "settings"),
        (lambda: tr.Odometry(CAMERA, start=2 * np.eye(4)), "start"),
        (lambda: tr.Odometry(CAMERA, start=np.eye(4) + np.eye(4, k=-1)[::-1]), "start"),
    ],
)
def test_wrong_arguments_are_named(call, named):
    with pytest.raises(tr.InputError, match=named):
        call()
