"""The commands and Python examples of the README and of docs run."""

import contextlib
import pydoc
import re
import shlex
import shutil
import textwrap
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

import thesis_repro as tr
from thesis.run_settings import ROOT
from thesis_repro.command import cli
from thesis_repro.command.options import build_parser
from thesis_repro.data.cameras import read_camera
from thesis_repro.data.trajectories import read_poses
from thesis_repro.masks import KINDS
from thesis_repro.odometry.estimators import ESTIMATORS

TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(path, language):
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize(
    "text, names", [("own-data", [*KINDS][1:]), ("reading-results", ESTIMATORS)]
)
def test_each_kind_of_mask_and_each_estimator_is_explained(text, names):
    words = (ROOT / f"docs/{text}.md").read_text(encoding="utf-8")
    assert [name for name in names if not re.search(rf"[` ]{name}`", words)] == []


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_commands_in_texts_have_their_options(path):
    parser = build_parser(cli.COMMANDS)
    for block in blocks(path, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            program, *words = shlex.split(line, comments=True) or [""]
            if program.endswith("thesis-repro"):
                assert parser.parse_args(words).command


def test_the_example_of_the_readme_compares_three_paths(small_world, tmp_path, monkeypatch, capsys):
    (example,) = blocks(ROOT / "README.md", "python")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "world").symlink_to(small_world)
    (tmp_path / "labels").symlink_to(small_world / "kitti/sequences/00/labels_0")
    names = {}
    exec(example, names)
    paths = names["plain"], names["masked"], names["few"]
    assert [len(path.poses) for path in paths] == [12, 12, 12]
    every, masked, few = [path.frames["detected"].mean() for path in paths]
    assert few == 200 and 200 < masked < every
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_help_begins_with_an_example_that_runs(small_world, tmp_path, monkeypatch, capsys):
    screen = pydoc.plain(pydoc.render_doc(tr)).splitlines()[:24]
    named = re.findall(r"\w+", "\n".join(screen))
    assert {"spread", "orb", "refined", "run_many"} <= {*named}
    monkeypatch.chdir(tmp_path)
    (tmp_path / "world").symlink_to(small_world)
    (tmp_path / "labels").symlink_to(small_world / "kitti/sequences/00/labels_0")
    example = textwrap.dedent("\n".join(re.findall(r"^    .*", tr.__doc__, re.MULTILINE)))
    assert len(example.splitlines()) <= 15
    names = {}
    exec(example, names)
    for name in names["runs"]:
        assert len(read_poses(f"{name}.txt")) == 12
    assert names["result"].frames["detected"].mean() == 200  # the last one, spread


@pytest.fixture(scope="module")
def examples(small_world, tmp_path_factory):
    """The Python recipes for what people bring, run beside a world and its frames and video.

    Returns the folder where they ran, the six frames, and the names that each leaves.
    """
    folder = tmp_path_factory.mktemp("examples")
    shutil.copytree(small_world, folder / "world")
    drive = folder / "world/kitti/sequences/00"
    for path in sorted(drive.glob("*/*.png")):
        if int(path.stem) >= 6:
            path.unlink()
    for path in (drive / "times.txt", folder / "world/kitti/poses/00.txt"):
        path.write_text("".join(path.read_text().splitlines(keepends=True)[:6]))
    (folder / "frames").symlink_to(drive / "image_0")
    images = [cv2.imread(str(path)) for path in sorted((folder / "frames").iterdir())]
    height, width = images[0].shape[:2]
    kind = cv2.VideoWriter_fourcc(*"mp4v")
    video = cv2.VideoWriter(str(folder / "drive.mp4"), kind, 25, (width, height))
    for image in images:
        video.write(image)
    video.release()
    results = []
    with contextlib.chdir(folder):
        for example in blocks(ROOT / "docs/own-data.md", "python"):
            names = {}
            exec(example, names)
            results.append(names)
    return folder, images, results


def test_the_recipes_for_what_people_bring_run(examples):
    folder, images, (memory, network, own, video, _) = examples
    sequence, result = memory["sequence"], memory["result"]
    assert len(sequence) == len(images) == len(result.poses)
    np.testing.assert_allclose(sequence.scales[1:], 8.3 / 25)
    assert 1.4 < np.linalg.norm(result.poses[-1, :3, 3]) < 1.7  # five steps
    assert np.array_equal(read_poses(folder / "path.txt"), result.poses)

    last, mask = network["step"], network["mask_of"](images[-1][..., 0])
    u, v = last.keypoints.astype(int).T
    assert len(u) > 100 and mask[v, u].all()
    assert 4.6 < np.linalg.norm(last.pose[:3, 3]) < 5.1  # five steps of a metre

    counts = own["result"].frames["detected"]
    plain = own["detect"](images[0][..., 0], None, None)
    assert counts[0] == len(plain) and own["result"].frames["updated"][1:].all()
    truth = tr.Sequence(folder / "world/kitti", 0).poses
    assert tr.metrics.errors(own["result"].poses, truth)["rmse"] < 0.25  # of five steps

    (folder / "camera.txt").write_text("300 300 240 80")
    made = folder / video["folder"]
    sequence = tr.Sequence(None, made, calibration=folder / "camera.txt")
    assert len(sequence) == len(images)
    np.testing.assert_allclose(np.diff(sequence.times), 1 / 25, atol=1e-6)
    height, width = sequence.size  # an even number of columns, as the encoder wants
    expected = images[5][:height, :width, 0].astype(int)
    assert np.abs(sequence[5] - expected).mean() < 5  # compressed

    camera = read_camera(folder / "sensor.yaml")
    assert camera.matrix[0, 0] == 458.7 and camera.distortion[3] == 0.00002
    assert np.array_equal(camera.body[:3, 3], [-0.02, -0.06, 0.01])


def test_the_recipe_for_own_matches_finds_where_points_went(examples):
    _, images, (_, _, own, _, _) = examples
    frame, mask = images[0][..., 0], np.zeros(images[0].shape[:2], np.uint8)
    mask[:, 100:] = 255
    points = own["detect"](frame, None, mask)
    assert points.shape == (len(points), 2) and points[:, 0].min() >= 100
    moved = np.roll(frame, (2, 5), axis=(0, 1))
    tracked, was_found = own["track"](frame, moved, points, None)
    assert tracked.shape == points.shape and was_found.dtype == bool
    is_right = np.abs(tracked - points - [5, 2]).max(axis=1) < 0.5
    assert is_right[was_found].mean() > 0.95 and was_found.mean() > 0.8
    _, was_found = own["track"](frame, np.zeros_like(frame), points, None)  # nothing to match
    assert not was_found.any()


def test_the_recipe_for_a_video_says_that_frames_are_missing(tmp_path, monkeypatch, capsys):
    """The decoder ends at the damaged frame, as at the end."""
    monkeypatch.chdir(tmp_path)
    (recipe,) = (text for text in blocks(ROOT / "docs/own-data.md", "python") if "Video" in text)
    form = cv2.VideoWriter_fourcc(*"MJPG")
    writer = cv2.VideoWriter("drive.avi", form, 10, (96, 64))
    noise = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    for _ in range(20):
        writer.write(noise)
    writer.release()
    data = bytearray(Path("drive.avi").read_bytes())
    start = data.find(b"\xff\xd8", len(data) // 2)
    data[start : start + 4000] = bytes(4000)
    Path("drive.avi").write_bytes(data)
    exec(recipe.replace("drive.mp4", "drive.avi"), {})
    count = len([*Path("my-drive").glob("*.png")])
    assert 0 < count < 20 and capsys.readouterr().out == f"{count} of 20 frames\n"


@pytest.mark.real
@pytest.mark.torture
def test_the_recipe_for_own_matches_is_as_good_as_the_tracker_on_a_street(kitti_real):
    (recipe,) = (text for text in blocks(ROOT / "docs/own-data.md", "python") if "SIFT" in text)
    street = tr.Sequence(kitti_real, "05").subset(20)
    names = {"street": street}
    exec(recipe.replace('tr.Sequence("world/kitti", 0)', "street"), names)
    own, usual = (
        tr.metrics.errors(run.poses, street.poses)["rmse"]
        for run in (names["result"], tr.run(street))
    )
    assert own < 2 * usual < 0.25


def test_the_changelog_has_one_release_below_what_is_unreleased():
    text = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    *unreleased, release = re.findall("^## .*", text, re.MULTILINE)
    assert unreleased in ([], ["## Unreleased"])
    words = len(text.partition(release)[2].split())
    if words > 340:  # with the marks of items
        warnings.warn(f"CHANGELOG.md: {release} has {words} words", stacklevel=1)


@pytest.mark.parametrize("path", [*TEXTS, ROOT / "CONTRIBUTING.md"], ids=lambda path: path.name)
def test_code_that_texts_name_exists(path):
    text = path.read_text(encoding="utf-8")
    rooms = r"(?:tests|tools|keypoint_study|thesis_repro|notebooks|opencv_exact|street_world)"
    named = re.findall(rf"`({rooms}/[\w./]+)`|(?<= )({rooms}/[\w./]+)`", text)
    missing = [name for pair in named for name in pair if name and not (ROOT / name).exists()]
    assert missing == []
