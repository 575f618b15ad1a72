"""The manifest of the evidence, and roots of frames that are cut from whole sequences."""

import shutil

import cv2
import numpy as np
import pandas as pd
import pytest

import evidence
import excerpts as command
from thesis import real_frames, run
from thesis.run_settings import read_settings
from thesis_repro.data.sequence import Sequence
from thesis_repro.errors import InputError


def settings_of(**variables):
    return read_settings({f"THESIS_REPRO_{name}": str(text) for name, text in variables.items()})


def test_a_cut_has_the_frames_poses_and_times_of_their_numbers(tiny_kitti, tmp_path):
    whole = Sequence(tiny_kitti, "00")
    part = real_frames.cut(whole, 1, 2, tmp_path / "cut", "part")
    assert part.name == "part" and len(part) == 2
    for index in (0, 1):
        assert np.array_equal(part.frame(index), whole.frame(index + 1))
    assert np.array_equal(part.poses, whole.poses[1:3])
    assert np.array_equal(part.times, whole.times[1:3])
    assert np.array_equal(part.intrinsics, whole.intrinsics)
    second = real_frames.cut(whole, 0, 3, tmp_path / "cut", "second", every=2)
    assert [path.name for path in second.frame_paths] == ["000000.png", "000002.png"]
    assert np.array_equal(second.poses, whole.poses[::2])
    assert np.array_equal(second.times, whole.times[::2])
    with pytest.raises(InputError, match="00: has 4 frames; 2 to 4 "):
        real_frames.cut(whole, 2, 4, tmp_path / "cut", "part")


def test_a_second_cut_writes_only_what_differs(tiny_kitti, tmp_path):
    whole = Sequence(tiny_kitti, "00")
    part = real_frames.cut(whole, 0, 2, tmp_path, "00")
    times = [path.lstat().st_mtime_ns for path in part.files]
    assert [
        path.lstat().st_mtime_ns for path in real_frames.cut(whole, 0, 2, tmp_path, "00").files
    ] == times
    shorter = real_frames.cut(whole, 1, 2, tmp_path, "00")
    assert [path.name for path in shorter.frame_paths] == ["000001.png", "000002.png"]


def test_ranges_of_frames_are_a_run_of_their_own(tiny_kitti, tmp_path):
    shutil.copytree(tiny_kitti / "sequences/00", tiny_kitti / "sequences/01")
    shutil.copy(tiny_kitti / "poses/00.txt", tiny_kitti / "poses/01.txt")
    given = {"KITTI": tiny_kitti, "BUILD": tmp_path / "build", "PROFILE": "smoke"}
    settings = settings_of(FRAMES="01:1-3", **given)
    assert settings.run.endswith("-smoke-frames-all-01_1_3") and settings.sizes.frames is None
    assert run.check(settings)
    (part,) = evidence.opened(settings)
    assert (part.name, len(part)) == ("01", 3)
    assert settings_of(FRAMES="2", **given).kitti == tiny_kitti
    for text in ("01:3-1", "01:1", "01:0-1,01:2-3", "x:-"):
        with pytest.raises(InputError, match="^FRAMES="):
            settings_of(FRAMES=text, **given)
    with pytest.raises(InputError, match="KITTI"):
        settings_of(FRAMES="01:0-1")


@pytest.fixture
def manifest(tiny_kitti, tmp_path, monkeypatch):
    """A manifest of frames 0 to 2 of the tiny sequence, and of a raw drive."""
    street = Sequence(tiny_kitti, "00").subset(3)
    row = {"street": "00", "data": "odometry", "sequence": "00", "camera": "image_0"}
    row |= {"first": 0, "last": 2, "made": "as published", **real_frames.digests(street)}
    drive = row | {"street": "drive1", "data": "raw", "sequence": "0001", "date": "2011_09_26"}
    path = tmp_path / "frames.csv"
    pd.DataFrame([row, drive]).to_csv(path, index=False)
    monkeypatch.setattr(real_frames, "MANIFEST", path)
    return street


def test_streets_that_differ_or_are_missing_are_told(manifest, tiny_kitti, tmp_path):
    told = command.cut_streets(str(tiny_kitti), "", tmp_path / "cut")
    assert list(told) == ["drive1"] and "RAW" in told["drive1"]
    cv2.imwrite(str(tiny_kitti / "sequences/00/image_0/000001.png"), np.zeros((48, 64), np.uint8))
    told = command.cut_streets(str(tiny_kitti), str(tmp_path), tmp_path / "cut")
    assert told["00"].startswith("other frames than") and "drive_0001_sync" in told["drive1"]


def test_evidence_of_other_frames_goes_elsewhere(manifest, tiny_kitti, tmp_path, monkeypatch):
    given = {"KITTI": tiny_kitti, "FIGURES": tmp_path / "figures"}
    whole = settings_of(PROFILE="thesis", **given)
    elsewhere = evidence.folder_of(whole)  # other frames
    assert elsewhere.parent == tmp_path / "figures" and elsewhere.name.endswith("-evidence")
    table = pd.read_csv(real_frames.MANIFEST, dtype=str)
    table[table["street"] == "00"].to_csv(real_frames.MANIFEST, index=False)
    real_frames.cut(manifest, 0, 2, tmp_path / "cut", "00")
    cut = given | {"KITTI": tmp_path / "cut"}
    assert evidence.folder_of(settings_of(PROFILE="thesis", **cut)) == evidence.FOLDER
    assert evidence.folder_of(settings_of(PROFILE="smoke", **cut)) != evidence.FOLDER


@pytest.mark.real
@pytest.mark.torture
def test_the_manifest_is_that_of_the_real_frames(kitti_real, tmp_path):
    raw = kitti_real.parent / "kitti_raw"
    told = command.cut_streets(str(kitti_real), str(raw), tmp_path)
    assert list(told) == ["drive0009"]  # only its rectified frames are at hand
    street = real_frames.read_manifest().loc["drive0009"]
    assert real_frames.differences(Sequence(kitti_real, "drive0009"), street) == []
    for name in ("drive0005", "drive0095"):
        poses = np.loadtxt(raw / "poses" / f"{name}.txt").reshape(-1, 3, 4)
        made = Sequence(tmp_path, name).poses[:, :3]
        assert np.array_equal(
            np.round(made, real_frames.DECIMALS), np.round(poses, real_frames.DECIMALS)
        )
