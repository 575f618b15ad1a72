"""The notebooks are executed once, on the smallest profile, as they are in git."""

import json
import os
import re
import subprocess

import nbformat
import pytest
from cells import NOTEBOOKS
from making import EXECUTED, FIGURES, make_figures
from nbclient import NotebookClient

from thesis_repro.running.settings import ROOT

TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}
# a call that saves a figure, at the start of a line
SAVED = re.compile(r"^(?:style\.save_figure\(|keep\((?:\w+\.)?figure|keep_paths\()", re.MULTILINE)
JUPYTER = ROOT / ".venv" / "bin" / "jupyter-nbconvert"


def environment(build):
    """Variables of a kernel: no setting of the Makefile but profile and folders."""
    variables = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
    return variables | {
        "PYTHONPATH": str(ROOT),
        "THESIS_REPRO_PROFILE": "smoke",
        "THESIS_REPRO_BUILD": str(build),
        "THESIS_REPRO_FIGURES": str(build.parent / "figures"),
        "IPYTHONDIR": str(build.parent / "ipython"),
    }


def execute(name, build, output):
    """Execute a notebook in its folder by what nbconvert uses, and write it with its outputs.

    This spares the start of nbconvert, three seconds each.
    """
    notebook = nbformat.read(ROOT / "notebooks" / name, 4)
    folder = {"metadata": {"path": str(ROOT / "notebooks")}}
    client = NotebookClient(notebook, kernel_name="python3", resources=folder)
    client.execute(env=environment(build) | {"WATCHED": name[:2]})
    nbformat.write(notebook, output / name)


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """A folder with build and figures of a run in which every notebook was executed."""
    folder = tmp_path_factory.mktemp("run")
    run = folder / "build" / "embedded-smoke"
    (run / "notebooks").mkdir(parents=True)
    (run / "checked").touch()  # as if make had checked the data
    # executed by every kernel
    startup = folder / "ipython" / "profile_default" / "startup" / "watch.py"
    startup.parent.mkdir(parents=True)
    startup.write_text(
        f"import sys\nsys.path.append({str(ROOT / 'tests')!r})\nfrom drawn import Watch\n"
        f"Watch(get_ipython(), {str(folder)!r})\n"
    )
    for name in NOTEBOOKS:
        execute(name, folder / "build", run / "notebooks")
        if name == NOTEBOOKS[0]:
            (run / "drives").touch()  # as if make had rendered the drives
    return folder


@pytest.mark.notebooks
def test_every_artefact_is_written_and_names_its_data(executed):
    figures = executed / "figures" / "embedded-smoke"
    written = {path.stem: path for path in figures.iterdir() if path.suffix in (".svg", ".webp")}
    assert set(FIGURES) <= written.keys() and len(FIGURES) == 36
    assert all(
        (figures / f"{name}{suffix}").is_file() for name in TABLES for suffix in (".csv", ".md")
    )
    texts = [written[name] for name in FIGURES if name not in WITHOUT_DATA]
    texts += [figures / f"{name}.md" for name in TABLES[2:]]
    assert [path.name for path in texts if b"embedded world" not in path.read_bytes()] == []


@pytest.mark.notebooks
def test_figures_have_no_raw_tex_and_no_texts_that_overlap(executed):
    faults = (executed / "faults.txt").read_text().splitlines()
    assert {f"{name}: saved" for name in FIGURES} <= set(faults)
    assert [fault for fault in faults if not fault.endswith(": saved")] == []


@pytest.mark.notebooks
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_every_cell_shows_the_figures_that_it_saves(executed, name):
    read = json.loads((executed / "build/embedded-smoke/notebooks" / name).read_text())["cells"]
    hidden = {}
    for cell in read:
        saved = len(SAVED.findall("".join(cell["source"]))) * (cell["cell_type"] == "code")
        shown = sum("image/png" in output.get("data", ()) for output in cell.get("outputs", ()))
        if shown < saved:
            hidden["".join(cell["source"])[:60]] = (saved, shown)
    assert hidden == {}


@pytest.mark.notebooks
def test_cells_and_package_agree_to_the_bit(executed):
    outputs = "".join(
        json.dumps(cell.get("outputs", []))
        for name in NOTEBOOKS
        for cell in json.loads((executed / "build/embedded-smoke/notebooks" / name).read_text())[
            "cells"
        ]
    )
    assert (
        outputs.count("to the bit: True") >= 10
        and "to the bit: False" not in outputs
        and "EDITED" not in outputs
    )


@pytest.mark.notebooks
def test_make_figures_executes_no_notebook_twice(executed):
    done = make_figures(executed)
    assert done.returncode == 0 and not re.findall(r"^\d\d_\w+", done.stdout, re.MULTILINE), (
        done.stdout + done.stderr
    )
    assert "41 of 41" in (executed / "figures" / "embedded-smoke" / "index.html").read_text()


@pytest.mark.notebooks
def test_a_notebook_without_its_input_names_the_one_to_run_first(tmp_path):
    """By nbconvert, as its users execute a notebook."""
    execution = ["--to", "notebook", "--execute", "--ExecutePreprocessor.kernel_name=python3"]
    notebook = ROOT / "notebooks" / "02_augmentation.ipynb"
    done = subprocess.run(
        [JUPYTER, *execution, "--output-dir", tmp_path, notebook],
        env=environment(tmp_path / "build"),
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0 and "01_load_images_and_labels" in done.stderr
    assert not list(tmp_path.glob("*.ipynb"))


@pytest.mark.notebooks
@pytest.mark.parametrize(
    "changed, again",
    [
        ("notebooks/06_keypoint_masks.ipynb", ["06", "07", "08", "09"]),
        ("notebooks/07_visual_odometry.ipynb", ["07", "08", "09"]),
        ("thesis_repro/masks.py", [name[:2] for name in NOTEBOOKS]),
        ("street_world/street.py", [name[:2] for name in NOTEBOOKS]),
        ("notebooks/thesis/chapter4.py", [name[:2] for name in NOTEBOOKS]),
        ("thesis_repro/report/page.py", []),
    ],
)
def test_only_what_changed_is_made_again(executed, changed, again):
    # -o: the check of the data is always made, and touches its file if the data has changed
    planned = make_figures(
        executed, "-n", "-W", changed, "-o", executed / "build" / "embedded-smoke" / "checked"
    )
    assert planned.returncode == 0
    assert EXECUTED.findall(planned.stdout.replace("\\\n", "")) == again, planned.stdout


@pytest.mark.notebooks
@pytest.mark.parametrize(
    "number, numbers",
    [
        ("04", {r"= (0\.0011), a hundredth": r"(0\.0011)"}),
        ("06", {r"(\d+) keypoints on the mask": r"(\d+) keypoints on the mask"}),
        (
            "07",
            {
                r"the direction is (\S+) degrees off": r"direction (\S+) degrees off",
                r"(\d+ inliers of \d+) matched": r"(\d+ inliers of \d+) matched",
            },
        ),
    ],
)
def test_sliders_show_the_numbers_of_the_cells_above_after_all_cells(executed, number, numbers):
    """After the last cell, the sliders' functions are called again, where the sliders stand."""
    (path,) = (executed / "build/embedded-smoke/notebooks").glob(f"{number}_*.ipynb")
    (shown,) = (executed / f"sliders-{number}.txt").read_text().splitlines()
    text = "\n".join(
        cell["source"] * (cell["cell_type"] == "markdown")
        + "".join(output.get("text", "") for output in cell.get("outputs", ()))
        for cell in nbformat.read(path, 4).cells
    )
    for of_cells, of_slider in numbers.items():
        assert re.search(of_slider, shown)[1] == re.search(of_cells, text)[1], shown
