"""What is missing, damaged or certainly wrong is one line with its file."""

import shutil
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from made_up import winding

from thesis import run
from thesis.run_settings import read_settings
from thesis_repro import checks
from thesis_repro.command.cli import main
from thesis_repro.data.sequence import Sequence
from thesis_repro.masks.folders import LabelMasks, MaskFolder
from thesis_repro.running import files

IMAGES = "sequences/00/image_0"


def test_every_damaged_file_is_named_and_the_exit_code_is_1(tiny_kitti, tiny_cityscapes, capsys):
    shutil.copytree(tiny_kitti / "sequences/00", tiny_kitti / "sequences/01")
    (tiny_kitti / "sequences/01/times.txt").write_text("0\n0.1\n0.1\n0.2\n")
    frame = tiny_kitti / IMAGES / "000001.png"
    frame.write_bytes(frame.read_bytes()[:100])
    damaged = bytearray((tiny_kitti / IMAGES / "000002.png").read_bytes())
    damaged[len(damaged) // 2] ^= 1
    (tiny_kitti / IMAGES / "000002.png").write_bytes(damaged)
    cv2.imwrite(str(tiny_kitti / IMAGES / "000003.png"), np.zeros((9, 9), np.uint8))
    (tiny_cityscapes / "trainannot/street_3.png").unlink()
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_0.png"), np.full((16, 32), 200, np.uint8))
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_1.png"), np.full((8, 8), 7, np.uint8))
    roots = ["--kitti", str(tiny_kitti), "--cityscapes", str(tiny_cityscapes)]
    assert main(["check-data", *roots]) == 1
    problems = sorted(capsys.readouterr().err.splitlines())
    named = [
        "000001.png",
        "000002.png",
        "000003.png: 9x9",
        "times.txt, line 3",
        "train/street_3.png",
        "street_0.png: label id 200",
        "street_1.png: 8x8",
    ]
    assert len(problems) == len(named)
    for text in named:
        assert sum(text in problem for problem in problems) == 1, text


def test_sequences_without_ground_truth_need_no_poses(tiny_kitti):
    folder = tiny_kitti / "sequences/11"
    shutil.copytree(tiny_kitti / "sequences/00", folder)
    (folder / "times.txt").unlink()
    (folder / "image_0").rename(folder / "image_2")
    (folder / "calib.txt").write_text("P2: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    assert checks.check_kitti(tiny_kitti) == []
    (tiny_kitti / "poses/00.txt").unlink()
    (tiny_kitti / "poses/11.txt").touch()
    problems = checks.check_kitti(tiny_kitti)
    assert [line.split("poses/")[1][:6] for line in problems] == ["00.txt", "11.txt"]


def test_unchanged_data_is_checked_once(tiny_kitti, tmp_path, capsys):
    folders = {"THESIS_REPRO_KITTI": tiny_kitti, "THESIS_REPRO_BUILD": tmp_path / "build"}
    settings = read_settings({name: str(folder) for name, folder in folders.items()})
    reports = []
    for _ in range(2):
        assert run.check(settings)
        reports.append(str(tiny_kitti) in capsys.readouterr().out)
    shutil.copy(tiny_kitti / IMAGES / "000001.png", tiny_kitti / IMAGES / "000000.png")
    assert run.check(settings)
    reports.append(str(tiny_kitti) in capsys.readouterr().out)
    assert reports == [True, False, True]


@pytest.mark.parametrize(
    "times, speed, scale, said",
    [
        ([0, 0.1, 0.2, 0.3], None, 1, []),
        ([0, 0.1, 0.2, 0.3], None, 9, []),  # 90 m/s
        ([0, 0.1, 0.2, 0.3], None, 100, ["3 of 3 steps"]),  # centimetres
        (None, None, 40, []),  # a frame a second
        (None, None, 1000, ["3 of 3 steps"]),  # millimetres
        ([0, 1e8, 2e8, 3e8], 8, 1, ["8e+08 m in 1e+08 s"]),  # nanoseconds
        ([0, 0.1, 0.2, 60], 8, 1, ["1 of 3 steps"]),
    ],
)
def test_steps_that_nothing_drives_are_named(tiny_kitti, times, speed, scale, said):
    if times:
        (tiny_kitti / "sequences/00/times.txt").write_text("".join(f"{t}\n" for t in times))
    else:
        (tiny_kitti / "sequences/00/times.txt").unlink()
    poses = tiny_kitti / "poses/00.txt"
    poses.write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {scale * index}\n" for index in range(4)))
    if speed:
        poses.unlink()
    lines = checks.sequence_warnings(Sequence(tiny_kitti, "00", speed=speed))
    assert len(lines) == len(said)
    assert all(text in line for text, line in zip(said, lines))


def test_flags_and_steps_that_were_left_out_are_told():
    assert checks.run_warnings("00", frames=100, failed=50, dropped=9) == []
    failed, dropped = checks.run_warnings("00", 100, 51, 10, 0.1)
    assert "51 of 100" in failed and "10 of 100" in dropped and "--scale-gate" in dropped


AXES = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])  # x forward, z up


@pytest.mark.parametrize(
    "change, told",
    [
        (lambda poses: poses, False),
        (np.linalg.inv, True),
        (lambda poses: AXES @ poses @ AXES.T, False),  # nobody knows what it is
        (lambda poses: np.linalg.inv(poses)[:10], False),  # too few steps
    ],
)
def test_a_truth_that_fits_better_inverted_is_told(change, told):
    estimated = winding(60)
    estimated[:, :3, 3] += np.random.default_rng(1).normal(0, 0.05, (60, 3))
    poses = change(winding(60))
    sequence = SimpleNamespace(poses=poses, poses_path="poses.txt")
    lines = checks.inverted_truth(sequence, estimated[: len(poses)])
    assert ["poses.txt: the truth fits better inverted" in line for line in lines] == [True] * told


STREET = np.repeat([[23], [11], [7]], 16, axis=0).repeat(64, axis=1).astype(np.uint8)
TRAIN = np.choose(STREET // 8, [0, 2, 10]).astype(np.uint8)
CAMVID = np.choose(STREET // 8, [3, 1, 0]).astype(np.uint8)
HALF = np.repeat([[0, 255]], 48, axis=0).repeat(32, axis=1).astype(np.uint8)


@pytest.mark.parametrize("split", ["train", "val"])
@pytest.mark.parametrize(
    "label_map, said",
    [(STREET, None), (CAMVID, "above 3"), (TRAIN, "above 10")],
)
def test_training_label_maps_of_other_ids_are_told(tiny_cityscapes, capsys, split, label_map, said):
    for path in (tiny_cityscapes / f"{split}annot").iterdir():
        small = cv2.resize(label_map, (32, 16), interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(path), small)
    assert checks.check_cityscapes(tiny_cityscapes) == []
    told = [line for line in capsys.readouterr().out.splitlines() if "label maps hold" in line]
    assert [f"split {split}: " in line and said in line for line in told] == [True] * bool(said)


@pytest.mark.parametrize(
    "kind, picture, options, warning",
    [
        ("labels", STREET, {}, None),
        ("labels", TRAIN, {}, "--ids train"),
        ("labels", TRAIN, {"ids": "train"}, None),
        ("labels", CAMVID, {}, "no id above 3, so no sky, vegetation or cars"),
        ("labels", 0 * STREET + 23, {}, "nothing but sky"),
        ("labels", 0 * STREET, {"ids": "train"}, "nothing but road"),
        ("masks", HALF, {}, None),
        ("masks", 0 * HALF, {}, "--invert"),
        ("masks", HALF | 255, {}, "100.0%"),
    ],
)
def test_masks_that_cannot_be_right(tiny_kitti, tmp_path, kind, picture, options, warning):
    sequence, folder = Sequence(tiny_kitti, "00"), tmp_path / "masks"
    for name in sequence.label_names:
        files.write_png(folder / name, picture)
    source = MaskFolder(folder, sequence)
    if kind == "labels":
        source = LabelMasks(folder, sequence, 3, **options)
    line, warnings = checks.look_at_masks(source, sequence)
    assert ("label maps hold" in line) == (kind == "labels")
    assert [warning in line for line in warnings] == ([True] if warning else [])
