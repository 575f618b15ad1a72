"""The package in a user's own environment: with the oldest and the newest packages it allows."""

import os
import re
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from trials import PACKAGES, copy_project, refused, run, snapshot, succeed

import environment
from thesis.run_settings import ROOT
from thesis_repro.running import provenance

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
UV = Path(sys.executable).with_name("uv")
NO_INDEX = "error sending request"  # what uv says if it reaches no package index


def test_the_lock_has_a_version_of_every_requirement_in_its_range():
    locked = dict(re.findall(r"^([\w.-]+)==(\S+)", (ROOT / "environment.txt").read_text(), re.M))
    texts = [*PROJECT["dependencies"], *sum(PROJECT["optional-dependencies"].values(), [])]
    for requirement in map(Requirement, texts):
        assert requirement.specifier.contains(locked[requirement.name]), requirement
        assert requirement.specifier.contains(metadata.version(requirement.name)), requirement


def test_a_release_has_one_version():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    changes = re.findall(r"^## (.*)$", (ROOT / "CHANGELOG.md").read_text(), re.M)
    released = [name for name in changes if name != "Unreleased"]
    assert cited["version"] == PROJECT["version"] == released[0]


def uv(*words):
    words = [UV, *words, "--quiet", "--system-certs"]
    result = subprocess.run(list(map(str, words)), capture_output=True, text=True)
    if NO_INDEX in result.stderr:
        pytest.skip("no package index can be reached")
    assert result.returncode == 0, result.stderr


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """It is built from a copy, because building leaves files beside what it is built from."""
    folder = tmp_path_factory.mktemp("source")
    copy_project([*PACKAGES, "pyproject.toml", "README.md", "LICENSE"], folder)
    build = ("build", "--wheel", "--no-build-isolation", "--python", sys.executable)
    uv(*build, "--out-dir", folder / "dist", folder)
    return next((folder / "dist").glob("*.whl"))


# minutes of downloads: a job of their own in CI, `pytest -m torture tests/install`
@pytest.fixture(scope="module", params=["lowest-direct", "highest"])
def installed(request, wheel, tmp_path_factory):
    """The folder of a new environment without the extras, but with OpenCV."""
    folder = tmp_path_factory.mktemp(request.param) / "environment"
    uv("venv", "--python", sys.executable, folder)
    into = ("pip", "install", "--python", folder / "bin/python")
    versions = ("--only-binary", ":all:", "--resolution", request.param)
    uv(*into, *versions, "-r", ROOT / "pyproject.toml", "--extra", "opencv")
    uv(*into, "--no-deps", wheel)
    return folder


@pytest.mark.torture
def test_an_installed_package_runs_without_the_extras(
    installed, small_world, small_labels, tmp_path
):
    """Nothing is written beside it: only Python and Numba keep what they compile there."""

    def files():
        return {path for path in snapshot(installed) if "__pycache__" not in path.parts}

    def command(*words):
        # evo writes its settings into the home folder
        home = {"PYTHONPATH": None, "HOME": tmp_path, "XDG_CACHE_HOME": None}
        return run([installed / "bin/thesis-repro", *words], tmp_path, **home)

    before = files()
    kitti = ["--kitti", small_world / "kitti"]
    where = [*kitti, "--sequence", "00"]
    labels = ["--labels", small_labels / "00", "--dilation", 5]
    for words in (
        ["masks", *where, *labels, "--output", "written"],
        ["odometry", *where, "--masks", "written", "--output", "00.txt", "--json"],
        ["study", *kitti, "--labels", small_labels, "--widths", 5, "--output", "study"],
    ):
        done = command(*words)
        assert done.returncode == 0, done.stderr
    assert (tmp_path / "study/index.html").is_file()
    predicted = command("predict", "--images", small_world / "kitti", "--output", "predicted")
    refused(predicted, "thesis-repro[segmentation]")
    assert files() == before


@pytest.mark.torture
def test_notebooks_find_their_modules_from_any_folder(tmp_path):
    """As papermill executes them; `make setup` sees to it."""
    succeed([sys.executable, "-c", "import thesis.run_settings"], tmp_path, PYTHONPATH=None)


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


@pytest.fixture
def checkout(tmp_path):
    """A folder with the Makefile, and an environment that make takes for its own."""
    copy_project(["Makefile", "environment.txt", "pyproject.toml"], tmp_path)
    for name in (*PACKAGES, "notebooks", "tools"):
        (tmp_path / name).symlink_to(ROOT / name)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    return tmp_path


def test_make_that_only_plans_writes_nothing(checkout):
    figures = ["make", "-o", ".venv/ready", "figures", f"FIGURES={checkout}/figures"]
    before = snapshot(checkout)
    planned = succeed([*figures, "-n", "PROFILE=smoke"], checkout)
    assert "thesis.run" in planned.stdout and snapshot(checkout) == before


@pytest.mark.parametrize(
    "target, options, variables, named",
    [
        ("figures", ["EPOCH=3"], {}, "EPOCH: "),
        pytest.param(
            "figures", [], {"PROFILE": "smal"}, "PROFILE=smal: ", marks=pytest.mark.torture
        ),
        ("figures", ["BUILD=my results"], {}, "BUILD=my results: "),
        ("check-data", [], {"KITTI": "/no/such/folder"}, "/no/such/folder"),
        ("lab", ["PROFILE=labb"], {"CDPATH": "/"}, "PROFILE=labb: "),
    ],
)
def test_a_wrong_setting_is_named_wherever_it_stands(checkout, target, options, variables, named):
    words = ["make", "-o", "setup", target, *options]
    failed = run(words, checkout, **variables)
    assert failed.returncode == 2 and f"error: {named}" in failed.stderr
    assert all(
        f"{name}={text}" in failed.stdout for name, text in variables.items() if name != "CDPATH"
    )
    assert failed.left == []


def test_an_environment_that_no_longer_works_is_told(checkout, tmp_path):
    (checkout / ".venv").unlink()
    (checkout / ".venv/bin").mkdir(parents=True)
    (checkout / ".venv/ready").touch()
    for name, text in (("thesis-repro", "#!/moved/.venv/bin/python"), ("python", "#!/bin/sh")):
        (checkout / ".venv/bin" / name).write_text(text)
        (checkout / ".venv/bin" / name).chmod(0o755)
    failed = run(["make", "lint"], checkout)
    assert failed.returncode == 2 and "make clean" in failed.stderr
    assert environment.missing("numpy==1\nno-such==2  # x\n\n# What those need:\nother==3") == [
        "no-such"
    ]


def test_two_runs_in_one_folder_are_refused(checkout):
    folders = {"PROFILE": "smoke", "BUILD": str(checkout / "b"), "FIGURES": str(checkout / "f")}
    with provenance.claimed(checkout / "b" / "embedded-smoke" / "notebooks"):
        words = [f"{name}={value}" for name, value in folders.items()]
        second = run(["make", "-o", "setup", "figures", *words], checkout)
    assert second.returncode == 2 and "another run uses it" in second.stderr
    assert not list((checkout / "b").rglob("*.ipynb"))


@pytest.mark.parametrize(
    "version, system, machine, cure",
    [
        ((3, 10), "Linux", "x86_64", "PYTHON=python3.12"),
        ((3, 14), "Darwin", "arm64", "PYTHON=python3.12"),
        ((3, 12), "Darwin", "x86_64", "Dockerfile"),
        ((3, 12), "Windows", "AMD64", "WSL"),
        ((3, 13), "Darwin", "arm64", ""),
        ((3, 11), "Linux", "aarch64", ""),
    ],
)
def test_what_cannot_be_installed_is_said_with_its_cure(version, system, machine, cure):
    line = environment.reason(version, system, machine)
    assert cure in line and bool(line) == bool(cure) and "\n" not in line


def as_310(options, path, monkeypatch):
    """Look for a Python as Python 3.10 on Linux would, with a PATH and no package index."""
    monkeypatch.setattr(environment.sys, "version_info", (3, 10, 13))
    monkeypatch.setattr(environment.platform, "system", lambda: "Linux")
    monkeypatch.setenv("PATH", os.pathsep.join(map(str, path)))
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    environment.main(options)


def test_another_python_on_the_path_is_taken_if_python3_does_not_fit(tmp_path, monkeypatch, capsys):
    for name in ("shims", "real"):
        (tmp_path / name).mkdir()
    shim = tmp_path / "shims/python3.13"  # of a version that is not installed
    shim.write_text("#!/bin/sh\nexit 127\n")
    shim.chmod(0o755)
    folders = tmp_path / "shims", tmp_path / "real"
    with pytest.raises(SystemExit, match="PYTHON=python3.12"):
        as_310(["--search"], folders, monkeypatch)
    (tmp_path / "real/python3.11").symlink_to(Path(sys.executable).resolve())
    with pytest.raises(SystemExit, match="PYTHON=python3.12"):
        as_310([], folders, monkeypatch)
    capsys.readouterr()
    as_310(["--search"], folders, monkeypatch)
    out, err = capsys.readouterr()
    assert out == f"{tmp_path}/real/python3.11\n"
    assert err.count("\n") == 1 and "3.10" in err and out.strip() in err


def test_nothing_is_installed_if_the_python_does_not_fit(checkout, tmp_path):
    (checkout / ".venv").unlink()
    python = tmp_path / "python3.10"  # says so in place of tools/environment.py
    python.write_text("#!/bin/sh\necho error: cure >&2\nexit 1\n")
    python.chmod(0o755)
    failed = run(["make", "setup", f"PYTHON={python}"], checkout)
    assert failed.returncode == 2 and "cure" in failed.stderr and failed.left == []
