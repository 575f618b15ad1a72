"""What the notebooks show and write, and which of them `make figures` executes, and when."""

import re

import nbformat
import pytest
from cells import NOTEBOOKS
from trials import PACKAGES, copy_project, finish, start

from thesis.run_settings import ROOT

pytestmark = pytest.mark.notebooks
FIGURES = [
    *(f"figure_2_{n:02d}" for n in range(1, 13)),
    *(f"figure_3_{n:02d}" for n in range(1, 7)),
    *(f"figure_4_{n:02d}" for n in range(1, 18)),
    "figure_a_01",
]
TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}
# a call that saves a figure, at the start of a line
SAVED = re.compile(r"^\w+\.save_figure\(", re.MULTILINE)


def make_figures(tmp_path, *options, root=ROOT):
    folders = f"BUILD={tmp_path / 'build'}", f"FIGURES={tmp_path / 'figures'}"
    command = ["make", "figures", "PROFILE=smoke", *folders, "-o", "setup", *options]
    # the options of an outer make are not for this one
    return finish(start(command, root, PYTHONPATH=root, MAKEFLAGS=None, MFLAGS=None))


def code_cells(executed, name):
    """The code cells of an executed notebook."""
    path = executed / "build" / "embedded-smoke" / "notebooks" / name
    return [cell for cell in nbformat.read(path, 4).cells if cell.cell_type == "code"]


def printed(executed, name):
    """What the cells of an executed notebook print."""
    outputs = [output for cell in code_cells(executed, name) for output in cell.outputs]
    return "".join(output.get("text", "") for output in outputs)


def test_every_artefact_is_written_and_names_its_data(executed):
    figures = executed / "build" / "embedded-smoke" / "figures"
    written = {path.stem: path for path in figures.iterdir() if path.suffix in (".svg", ".webp")}
    assert set(FIGURES) <= written.keys() and len(FIGURES) == 36
    texts = [written[name] for name in FIGURES if name not in WITHOUT_DATA]
    texts += [figures / f"{name}.md" for name in TABLES[2:]]
    assert [path.name for path in texts if b"embedded world" not in path.read_bytes()] == []
    assert all((figures / f"{name}.csv").is_file() for name in TABLES)


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_is_executed_and_shows_the_figures_that_it_saves(executed, name):
    run = code_cells(executed, name)
    assert all(cell.execution_count for cell in run)  # the appendix's calls are executed
    shown = sum("image/png" in output.get("data", ()) for cell in run for output in cell.outputs)
    assert shown >= sum(len(SAVED.findall(cell.source)) for cell in run)


def test_cells_and_package_agree_to_the_bit(executed):
    texts = {name[:2]: printed(executed, name) for name in NOTEBOOKS}
    agreeing = {number: text.count("to the bit: True") for number, text in texts.items()}
    assert min(agreeing[each] for each in ("01", "02", "04", "05", "06", "07")) >= 1
    assert not [text for text in texts.values() if "to the bit: False" in text or "EDITED" in text]


def test_a_failing_notebook_does_not_stop_the_others(tmp_path):
    """On a copy of the project with small notebooks; copies beside the nine are left alone."""
    root = tmp_path / "project"
    copy_project([*PACKAGES, "notebooks/thesis", "tools", "docs"], root)
    copy_project(["Makefile", "environment.txt", "pyproject.toml"], root)
    (root / ".venv").symlink_to(ROOT / ".venv")
    (root / "tools" / "render_ahead.py").write_text("")  # it would compile the copy
    codes = dict.fromkeys(NOTEBOOKS, "print('by hand')")
    codes["02_augmentation.ipynb"] = "raise ValueError('labels: missing')"
    codes["03_unet.ipynb"] = "import os; os.abort()"
    codes |= dict.fromkeys(("01_load-Copy1.ipynb", "Untitled.ipynb"), "raise ValueError('a copy')")
    for name, code in codes.items():
        nbformat.write(
            nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]),
            root / "notebooks" / name,
        )
    failed = make_figures(tmp_path, root=root)
    assert failed.returncode != 0 and "labels: missing" in failed.stderr
    assert "Fatal Python error: Aborted" in failed.stderr and "a copy" not in failed.stderr
    assert (tmp_path / "figures" / "embedded-smoke" / "README.md").is_file()
    # hidden ones included
    written = (tmp_path / "build" / "embedded-smoke" / "notebooks").glob("*.ipynb")
    assert [path.name for path in written] == ["01_load_images_and_labels.ipynb"]


def test_bad_data_stops_before_the_notebooks(tmp_path, tiny_kitti):
    (tiny_kitti / "poses" / "00.txt").unlink()
    failed = make_figures(tmp_path, f"KITTI={tiny_kitti}")
    assert failed.returncode != 0 and "poses/00.txt" in failed.stderr
    assert not list((tmp_path / "build").rglob("*.ipynb"))
    assert "PROFIL: unknown setting" in make_figures(tmp_path, "PROFIL=smoke").stderr
