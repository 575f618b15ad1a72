"""What `make figures` executes when a notebook fails, or with real frames or bad data."""

import shutil

import nbformat
import pytest
from making import EXECUTED, make_figures

from thesis_repro.running.settings import ROOT


@pytest.mark.notebooks
def test_a_failing_notebook_does_not_stop_the_others(tmp_path):
    """On a copy of the project with two small notebooks."""
    root = tmp_path / "project"
    for folder in ("thesis_repro", "street_world", "notebooks/thesis"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__"))
    (root / ".venv").symlink_to(ROOT / ".venv")
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, root)
    for name, code in (
        ("01_one.ipynb", "print('by hand')"),
        ("02_two.ipynb", "raise ValueError('labels: missing')"),
    ):
        nbformat.write(
            nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]),
            root / "notebooks" / name,
        )
    failed = make_figures(tmp_path, root=root)
    assert failed.returncode != 0 and "labels: missing" in failed.stderr
    assert (tmp_path / "figures" / "embedded-smoke" / "index.html").is_file()
    # hidden ones included
    written = (tmp_path / "build" / "embedded-smoke" / "notebooks").glob("*.ipynb")
    assert sorted(path.name for path in written) == ["01_one.ipynb"]


@pytest.mark.notebooks
def test_real_frames_alone_need_no_training(tmp_path, tiny_kitti):
    options = f"KITTI={tiny_kitti}", f"RUN={tmp_path / 'run'}", "-n"
    planned = make_figures(tmp_path, *options, target="notebooks")
    assert planned.returncode == 0, planned.stderr
    assert EXECUTED.findall(planned.stdout.replace("\\\n", "")) == [
        "03",
        "05",
        "06",
        "07",
        "08",
        "09",
    ]


@pytest.mark.notebooks
def test_bad_data_stops_before_the_notebooks(tmp_path, tiny_kitti):
    (tiny_kitti / "poses" / "00.txt").unlink()
    failed = make_figures(tmp_path, f"KITTI={tiny_kitti}")
    assert failed.returncode != 0 and "poses/00.txt" in failed.stderr
    assert not list((tmp_path / "build").rglob("*.ipynb"))
    assert "PROFIL: unknown setting" in make_figures(tmp_path, "PROFIL=smoke").stderr
