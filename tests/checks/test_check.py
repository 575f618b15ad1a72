import shutil

import cv2
import numpy as np
import pytest

from thesis_repro.checks import check, oddities
from thesis_repro.checks.check import check_cityscapes, check_kitti
from thesis_repro.command.cli import main
from thesis_repro.data.kitti import Sequence
from thesis_repro.errors import InputError
from thesis_repro.masks import LabelMasks, MaskFolder, MaskSettings, read_mask
from thesis_repro.running import files, results

IMAGES = "sequences/00/image_0"


def test_every_problem_is_listed_and_the_exit_code_is_1(tiny_kitti, tiny_cityscapes, capsys):
    frame = tiny_kitti / IMAGES / "000001.png"
    frame.write_bytes(frame.read_bytes()[:100])
    cv2.imwrite(str(tiny_kitti / IMAGES / "000003.png"), np.zeros((9, 9), np.uint8))
    # frames of the right camera only
    shutil.copytree(tiny_kitti / IMAGES, tiny_kitti / "sequences/12/image_1")
    (tiny_kitti / "sequences/00/times.txt").write_text("0\n0.1\n0.1\n0.2\n")
    (tiny_kitti / "poses/00.txt").write_text("1 0 0 0 0 2 0 0 0 0 1 0\n" * 4)
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_0.png"), np.full((16, 32), 200, np.uint8))
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_1.png"), np.full((8, 8), 7, np.uint8))
    roots = ["--kitti", str(tiny_kitti), "--cityscapes", str(tiny_cityscapes)]
    assert main(["check-data", *roots]) == 1
    problems = sorted(capsys.readouterr().err.splitlines())
    named = [
        "000001.png",
        "000003.png: 9x9",
        "00.txt, line 1",
        "sequences/12: ",
        "times.txt, line 3",
        "street_0.png: label id 200",
        "street_1.png: 8x8",
    ]
    assert len(problems) == len(named)
    for text in named:
        assert sum(text in problem for problem in problems) == 1, text


def test_an_unreadable_first_frame_is_one_problem_among_others(tiny_kitti):
    for name in ("000000.png", "000002.png"):
        (tiny_kitti / IMAGES / name).write_bytes(b"no picture")
    _, problems = check_kitti(tiny_kitti)
    first, third = problems
    assert "000000.png" in first and "000002.png" in third


def test_damage_within_a_file_is_found_by_a_deep_check(tiny_kitti, tiny_cityscapes):
    frame, label = tiny_kitti / IMAGES / "000001.png", tiny_cityscapes / "trainannot/street_1.png"
    data = bytearray(frame.read_bytes())
    data[len(data) // 2] ^= 1
    frame.write_bytes(data)
    cv2.imwrite(str(label), np.full((16, 32), 200, np.uint8))
    assert check_kitti(tiny_kitti)[1] == check_cityscapes(tiny_cityscapes)[1] == []
    for problems, path in (
        (check_kitti(tiny_kitti, deep=True)[1], frame),
        (check_cityscapes(tiny_cityscapes, deep=True)[1], label),
    ):
        assert len(problems) == 1 and problems[0].startswith(f"{path}: ")


def test_missing_files_are_counted_and_named(tiny_kitti, tiny_cityscapes):
    images = tiny_kitti / IMAGES
    for index in range(4, 40):
        shutil.copy(images / "000000.png", images / f"{index:06d}.png")
    (tiny_kitti / "sequences/00/times.txt").write_text("".join(f"{index}\n" for index in range(40)))
    (tiny_kitti / "poses/00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 40)
    assert check_kitti(tiny_kitti)[1] == []
    missing = [images / f"{index:06d}.png" for index in (0, 3, 4, 5, 9, 38, 39)]
    for path in missing:
        path.unlink()
    _, problems = check_kitti(tiny_kitti)
    assert [problem.split(":")[0] for problem in problems] == [str(path) for path in missing]
    for index in range(4):
        (tiny_cityscapes / "trainannot" / f"street_{index}.png").unlink()
    for index in range(12):
        (tiny_cityscapes / "val" / f"lonely_{index}.png").write_bytes(b"")
    # four images without label maps, and twelve more: ten are named, the others counted, and there
    # is no pair
    for deep in (False, True):
        _, problems = check_cityscapes(tiny_cityscapes, deep)
        assert len(problems) == 4 + 12
    _, problems = check_cityscapes(tiny_cityscapes, splits=("train",))
    assert len(problems) == 4
    shutil.rmtree(tiny_cityscapes / "val")
    assert len(check_cityscapes(tiny_cityscapes)[1]) == 4 + 1


def test_sequences_without_ground_truth_need_no_poses(tiny_kitti):
    folder = tiny_kitti / "sequences/11"
    shutil.copytree(tiny_kitti / "sequences/00", folder)
    (folder / "times.txt").unlink()
    (folder / "image_0").rename(folder / "image_2")
    (folder / "calib.txt").write_text("P2: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    assert check_kitti(tiny_kitti)[1] == []
    (tiny_kitti / "poses/00.txt").unlink()
    _, problems = check_kitti(tiny_kitti)
    assert len(problems) == 1 and "poses/00.txt" in problems[0]


def test_unchanged_data_is_checked_once(tiny_kitti, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("THESIS_REPRO_KITTI", str(tiny_kitti))
    for frame, reports in ((None, True), (None, False), (0, True), (9, True)):
        if frame is not None:
            images = tiny_kitti / IMAGES
            shutil.copy(images / "000001.png", images / f"{frame:06d}.png")
        assert check.main(tmp_path / "checked") == (frame == 9)  # a missing frame
        assert (str(tiny_kitti) in capsys.readouterr().out) == reports


# Data that can be read but is implausible: one line with the measured number


def poses(*rows):
    return "".join(f"1 0 0 0 0 1 0 0 0 0 1 {row}\n" for row in rows)


@pytest.mark.parametrize(
    "path, text, seen",
    [
        ("poses/00.txt", poses(0, 100, 200, 300), "1000 m/s"),
        ("poses/00.txt", poses(0, 1, 2, 30), "280 m/s"),
        ("poses/00.txt", poses(0, -1, -2, -3), "-1.00"),
        ("sequences/00/times.txt", "0\n100\n200\n300\n", "100 s"),
        ("sequences/00/calib.txt", "P0: 50 0 20 0 0 50 24 0 0 0 1 0\n", "20, 24"),
        (f"{IMAGES}/000002.png", None, "000002"),
    ],
)
def test_implausible_data_is_one_line_with_the_number(tiny_kitti, path, text, seen):
    assert oddities.of_sequence(Sequence(tiny_kitti, "00")) == []
    if text:
        (tiny_kitti / path).write_text(text)
    else:
        shutil.copy(tiny_kitti / IMAGES / "000001.png", tiny_kitti / path)
    (line,) = oddities.of_sequence(Sequence(tiny_kitti, "00"))
    assert seen in line


def test_a_path_of_another_drive_is_reported():
    def drive(seed):
        path = np.tile(np.eye(4), (40, 1, 1))
        turns = np.random.default_rng(seed).normal(0, 0.02, 40)
        for pose, angle in zip(path, np.cumsum(turns)):
            pose[:3, :3] = cv2.Rodrigues(np.array([0, angle, 0]))[0]
        return path

    true = drive(0)
    assert oddities.of_path("00", true, true) == []
    assert oddities.of_path("00", drive(1), true) != []
    assert len(oddities.of_path("00", np.linalg.inv(true), true)) == 1
    # as if a file has w first
    upside_down = np.diag([1, -1, -1, 1]) @ true
    assert len(oddities.of_path("00", upside_down, true)) == 1


STREET = np.repeat([[23], [11], [7]], 16, axis=0).repeat(64, axis=1).astype(np.uint8)
TRAIN = np.choose(STREET // 8, [0, 2, 10]).astype(np.uint8)
STRIPS = np.full((48, 64), 255, np.uint8)  # a square of 31 pixels fits between them
STRIPS[[0, 1, 36, 37]] = STRIPS[:, [0, 1, 38, 39]] = 0
HALF = np.repeat([[0, 255]], 48, axis=0).repeat(32, axis=1).astype(np.uint8)


@pytest.mark.parametrize(
    "kind, picture, count, options, seen",
    [
        ("labels", STREET, 4, {}, None),
        ("labels", TRAIN, 4, {}, "--ids train"),
        ("labels", TRAIN, 4, {"ids": "train"}, None),
        ("labels", 0 * STREET, 4, {}, "unlabeled 0"),
        ("labels", STREET.T, 4, {}, "48x64"),
        ("labels", STREET, 5, {}, "5 files"),
        ("masks", HALF, 4, {}, None),
        ("masks", HALF, 1, {}, None),
        ("masks", 0 * HALF, 4, {}, "--invert"),
        ("masks", HALF | 255, 4, {}, "100.0%"),
        ("masks", STRIPS, 4, {}, "--invert"),
        ("masks", 255 - STRIPS, 4, {}, None),
    ],
)
def test_implausible_masks_are_one_line_with_the_option(
    tiny_kitti, tmp_path, kind, picture, count, options, seen
):
    folder = tmp_path / "masks"
    names = [f"{index:06d}.png" for index in range(count)]
    if count == 1:
        names = ["bonnet.png"]
    for name in names:
        files.write_png(folder / name, picture)
    sequence = Sequence(tiny_kitti, "00")
    if kind == "labels":
        settings = MaskSettings(**options)
        line, odd = oddities.of_masks(LabelMasks(folder, sequence, 3, settings), sequence)
    else:
        line, odd = oddities.of_masks(MaskFolder(folder, sequence), sequence)
    assert "%" in line and [seen in text for text in odd] == ([True] if seen else [])


def test_masks_of_other_frames_and_other_names_of_files(tiny_kitti, tmp_path):
    sequence, folder = Sequence(tiny_kitti, "00"), tmp_path / "masks"
    results.stage(folder, frames=results.digest_of_files(sequence.frame_paths))
    for path in sequence.frame_paths:
        files.write_png(folder / f"{path.name}.png", HALF)
    made = MaskFolder(folder, sequence)
    assert oddities.of_masks(made, sequence)[1] == []
    assert np.array_equal(MaskFolder(folder, sequence, invert=True)[2], 255 - HALF)
    assert np.array_equal(
        MaskFolder(made.paths[0], sequence)[3], read_mask(made.paths[0], sequence.size)
    )
    cv2.imwrite(str(sequence.frame_paths[0]), np.zeros((48, 64), np.uint8))
    assert len(oddities.of_masks(made, sequence)[1]) == 1
    # the mask of one frame is not one for all frames
    files.write_png(tmp_path / "unfinished" / "000000.png", HALF)
    with pytest.raises(InputError, match="000001.png"):
        MaskFolder(tmp_path / "unfinished", sequence)
