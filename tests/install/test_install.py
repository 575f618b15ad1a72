"""The package in a user's own environment: with the oldest and the newest packages it allows."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import cv2
import numpy as np
import pytest
from packaging.requirements import Requirement
from street import Street, Stripes
from trials import refused, run, snapshot, succeed

from thesis_repro.data.trajectories import write_kitti_poses
from thesis_repro.running.settings import ROOT

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
UV = Path(sys.executable).with_name("uv")
NO_INDEX = "error sending request"  # what uv says if it reaches no package index


def test_the_lock_has_a_version_of_every_requirement_in_its_range():
    locked = dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "environment.txt").read_text(), re.M))
    texts = [*PROJECT["dependencies"], *sum(PROJECT["optional-dependencies"].values(), [])]
    for requirement in map(Requirement, texts):
        assert requirement.specifier.contains(locked[requirement.name]), requirement
        assert requirement.specifier.contains(metadata.version(requirement.name)), requirement


def uv(*words):
    words = [UV, *words, "--quiet", "--system-certs"]
    result = subprocess.run(list(map(str, words)), capture_output=True, text=True)
    if NO_INDEX in result.stderr:
        pytest.skip("no package index can be reached")
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of what a wheel is built from, because building leaves files beside it."""
    folder = tmp_path_factory.mktemp("source")
    for name in ("thesis_repro", "street_world", "opencv_exact"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    for name in ("pyproject.toml", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    return folder


@pytest.fixture(scope="module")
def wheel(source):
    build = ("build", "--wheel", "--no-build-isolation", "--python", sys.executable)
    uv(*build, "--out-dir", source / "dist", source)
    return next((source / "dist").glob("*.whl"))


# The newest packages are nearly those of environment.txt, with which all other tests run.
VERSIONS = ["lowest-direct", pytest.param("highest", marks=pytest.mark.torture)]


@pytest.fixture(scope="module", params=VERSIONS)
def installed(request, source, wheel, tmp_path_factory):
    """The folder of a new environment without the extras, but with OpenCV."""
    folder = tmp_path_factory.mktemp(request.param) / "environment"
    uv("venv", "--python", sys.executable, folder)
    into = ("pip", "install", "--python", folder / "bin/python")
    versions = ("--only-binary", ":all:", "--resolution", request.param)
    uv(*into, *versions, "-r", source / "pyproject.toml", "--extra", "opencv")
    uv(*into, "--no-deps", wheel)
    return folder


@pytest.fixture
def drive(tmp_path):
    """A folder with a short sequence of KITTI, and a label map for each frame."""
    street = Street()
    sequence = tmp_path / "kitti/sequences/00"
    for folder in (sequence / "image_0", tmp_path / "labels"):
        folder.mkdir(parents=True)
    for index, frame in enumerate(street.images):
        cv2.imwrite(str(sequence / f"image_0/{index:06d}.png"), frame)
        cv2.imwrite(str(tmp_path / f"labels/{index:06d}.png"), Stripes(40)[index] // 255 * 7)
    projection = np.c_[street.intrinsics, np.zeros(3)].ravel()
    (sequence / "calib.txt").write_text("P0: " + " ".join(map(str, projection)) + "\n")
    (sequence / "times.txt").write_text("".join(f"{0.1 * index}\n" for index in range(len(street))))
    write_kitti_poses(tmp_path / "kitti/poses/00.txt", street.poses)
    return tmp_path


@pytest.mark.slow
def test_an_installed_package_runs_without_the_extras(installed, drive):
    """Nothing is written beside it: only Python and Numba keep what they compile there."""

    def files():
        return {path for path in snapshot(installed) if "__pycache__" not in path.parts}

    def command(*words):
        return [installed / "bin/thesis-repro", *words]

    before = files()
    home = {"PYTHONPATH": None, "HOME": drive / "home", "XDG_CACHE_HOME": None}
    where = ["--kitti", "kitti", "--sequence", "00"]
    masks = ["--labels", "labels", "--dilation", 5, "--output", "written"]
    succeed(command("masks", *where, *masks), drive, **home)
    odometry = [*where, "--masks", "written", "--output", "00.txt", "--json"]
    record = json.loads(succeed(command("odometry", *odometry), drive, **home).stdout)
    assert record["rmse_m"] < 0.05
    study = ["--kitti", "kitti", "--masks", "written", "--repetitions", 1, "--jobs", 1]
    succeed(command("study", *study, "--output", "study"), drive, **home)
    assert (drive / "study/index.html").is_file()
    example = re.findall(r"```python\n(.*?)```", (ROOT / "docs/own-masks.md").read_text(), re.S)[0]
    (drive / "frames").symlink_to(drive / "kitti/sequences/00/image_0")
    positions = succeed([installed / "bin/python", "-c", example], drive, **home).stdout
    assert len(positions.splitlines()) == len(Street())
    predicted = run(command("predict", "--images", "kitti", "--output", "predicted"), drive, **home)
    refused(predicted, "thesis-repro[segmentation]")
    assert files() == before


@pytest.mark.slow
def test_a_type_checker_sees_the_types_of_the_main_names(tmp_path):
    lines = [
        "import thesis_repro as tr",
        "tr.Sequence(1.5, '00')",
        "tr.run('00')",
        "tr.Odometri",
    ]
    (tmp_path / "user.py").write_text("\n".join(lines))
    # the types of other packages, which take four seconds to read, are not asked for
    command = [sys.executable, "-m", "mypy", "--no-site-packages", "user.py"]
    variables = os.environ | {"MYPYPATH": str(ROOT)}
    result = subprocess.run(command, cwd=tmp_path, env=variables, capture_output=True, text=True)
    wrong = re.findall(r"user\.py:(\d): error: .*\[([\w-]+)\]", result.stdout)
    assert wrong == [("2", "arg-type"), ("3", "arg-type"), ("4", "attr-defined")]


READY = ("-o", ".venv/ready")  # nothing is installed


@pytest.fixture
def checkout(tmp_path):
    """A folder with the Makefile, and an environment that make takes for its own."""
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return tmp_path


def test_make_reads_settings_from_its_arguments_and_the_environment(checkout):
    for folder in ("thesis_repro", "street_world", "opencv_exact", "notebooks"):
        (checkout / folder).symlink_to(ROOT / folder)
    planned = succeed(["make", *READY, "-n", "figures", "PROFILE=smoke", "BUILD=mine"], checkout)
    assert "mine/embedded-smoke/notebooks/01_load" in planned.stdout
    planned = succeed(["make", *READY, "-n", "figures"], checkout, THESIS_REPRO_BUILD="other")
    assert "other/embedded-demo/notebooks/01_load" in planned.stdout
    refused = run(["make", *READY, "figures", "EPOCH=3"], checkout)
    assert refused.returncode == 2 and "error: EPOCH: " in refused.stderr
