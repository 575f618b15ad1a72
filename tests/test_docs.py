"""The commands and Python examples of the README and of docs run."""

import contextlib
import pydoc
import re
import shlex
import textwrap
import warnings

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

    Returns the folder where they ran, the frames, and the names that each leaves.
    """
    folder = tmp_path_factory.mktemp("examples")
    (folder / "world").symlink_to(small_world)
    (folder / "frames").symlink_to(small_world / "kitti/sequences/00/image_0")
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
    folder, images, (memory, network, own, _) = examples
    sequence, result = memory["sequence"], memory["result"]
    assert len(sequence) == len(images) == len(result.poses)
    np.testing.assert_allclose(sequence.scales[1:], 8.3 / 25)
    assert 3 < np.linalg.norm(result.poses[-1, :3, 3]) < 3.7  # eleven steps
    assert np.array_equal(read_poses(folder / "path.txt"), result.poses)

    last, mask = network["step"], network["mask_of"](images[-1][..., 0])
    u, v = last.keypoints.astype(int).T
    assert len(u) > 100 and mask[v, u].all()
    assert 10 < np.linalg.norm(last.pose[:3, 3]) < 11.1  # eleven steps of a metre

    counts = own["result"].frames["detected"]
    plain = own["detect"](images[0][..., 0], None, None)
    assert counts[0] == len(plain) and own["result"].frames["updated"][1:].all()

    camera = read_camera(folder / "sensor.yaml")
    assert camera.matrix[0, 0] == 458.7 and camera.distortion[3] == 0.00002
    assert np.array_equal(camera.body[:3, 3], [-0.02, -0.06, 0.01])


def test_points_that_leave_the_frame_are_not_found_by_the_recipe_for_own_matches(examples):
    _, images, (*_, own, _) = examples
    frames = [image[..., 0] for image in images[:2]]
    height, width = frames[0].shape
    ends = [[-3, 9], [width, 9], [9, -3], [9, height], [0, 0], [width - 1, height - 1]]
    tracked, was_found = own["track"](*frames, np.float32(ends), None)
    assert tracked.shape == (6, 2) and was_found.tolist() == [False] * 4 + [True] * 2


@pytest.mark.real
@pytest.mark.torture
@pytest.mark.parametrize("sequence", ["00", "05"])
def test_the_recipe_for_own_matches_runs_on_a_whole_street(sequence, kitti_real):
    (recipe,) = (text for text in blocks(ROOT / "docs/own-data.md", "python") if "DIS" in text)
    names = {}
    exec(recipe.replace('"world/kitti", 0', f"{str(kitti_real)!r}, {sequence!r}"), names)
    poses = names["result"].poses
    assert np.isfinite(poses).all() and len(poses) == len(tr.Sequence(kitti_real, sequence))


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
