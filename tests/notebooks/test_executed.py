"""The notebooks are executed once, on the smallest profile, as they are in git."""

import os
import re

import nbformat
import pytest
from cells import NOTEBOOKS, named
from drawn import END
from making import EXECUTED, FIGURES, make_figures
from nbclient import NotebookClient

from thesis import page
from thesis_repro.running.settings import PREFIX, ROOT, read_settings

pytestmark = pytest.mark.notebooks
TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}
# a call that saves a figure, at the start of a line
SAVED = re.compile(r"^\w+\.save_figure\(", re.MULTILINE)


def environment(build):
    """Variables of a kernel: no setting of the Makefile but profile and folders."""
    variables = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
    folders = {f"{PREFIX}BUILD": str(build), f"{PREFIX}FIGURES": str(build.parent / "figures")}
    startup = {"IPYTHONDIR": str(build.parent / "ipython"), "PYTHONPATH": str(ROOT)}
    # without worker processes, which would each load what is compiled
    return variables | folders | startup | {f"{PREFIX}PROFILE": "smoke", f"{PREFIX}JOBS": "1"}


def execute(name, build, output):
    """Execute a notebook in its folder by what nbconvert uses, and write it with its outputs.

    This spares the start of nbconvert, three seconds each.
    """
    notebook = nbformat.read(ROOT / "notebooks" / name, 4)
    notebook.cells.append(nbformat.v4.new_code_cell(END))
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
    # no raw TeX, no texts that overlap
    faults = (executed / "faults.txt").read_text().splitlines()
    assert [fault for fault in faults if not fault.endswith(": saved")] == []


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_shows_the_figures_that_it_saves(executed, name):
    run = code_cells(executed, name)
    shown = sum("image/png" in output.get("data", ()) for cell in run for output in cell.outputs)
    assert shown >= sum(len(SAVED.findall(cell.source)) for cell in run)


def test_cells_and_package_agree_to_the_bit(executed):
    texts = {name[:2]: printed(executed, name) for name in NOTEBOOKS}
    agreeing = {number: text.count("to the bit: True") for number, text in texts.items()}
    assert sum(agreeing.values()) >= 10 and min(agreeing[each] for each in ("05", "06", "07")) >= 1
    assert not [text for text in texts.values() if "to the bit: False" in text or "EDITED" in text]


def test_the_page_shows_every_artefact(executed):
    assert "41 of 41" in page.build(read_settings(environment(executed / "build")))


@pytest.mark.parametrize(
    "changed, again",
    [
        (f"notebooks/{named('06')}", {"06", "07", "08", "09"}),
        (f"notebooks/{named('07')}", {"07"}),
        ("thesis_repro/mask_files.py", {"05", "06", "07", "08", "09"}),
        ("street_world/street.py", {name[:2] for name in NOTEBOOKS}),
        ("notebooks/thesis/domain_gap.py", {"05", "06", "07", "08", "09"}),
        ("notebooks/thesis/page.py", set()),
        ("docs/answer.md", set()),  # nothing is executed twice
    ],
)
def test_what_changed_is_made_again(executed, changed, again):
    # make passes -o and -W to no make that it starts, so the inner one plans
    run = os.path.relpath(executed / "build" / "embedded-smoke", ROOT)
    # -o: the check of the data is always made, and touches its file if the data has changed
    options = "-n", "-W", changed, "-o", f"{run}/checked", f"RUN={run}"
    planned = make_figures(executed, *options, target="notebooks")
    assert planned.returncode == 0
    assert set(EXECUTED.findall(planned.stdout.replace("\\\n", ""))) == again


@pytest.mark.parametrize(
    "number, numbers",
    [
        ("06", [r"(\d+) keypoints on the mask"]),
        ("07", [r"direction (\S+) degrees off", r"(\d+ inliers of \d+) matched"]),
    ],
)
def test_sliders_show_the_numbers_of_the_cells_above_after_all_cells(executed, number, numbers):
    """After the last cell, the sliders' functions are called again, where the sliders stand."""
    (shown,) = (executed / f"sliders-{number}.txt").read_text().splitlines()
    for pattern in numbers:
        assert (
            re.search(pattern, shown)[1] == re.search(pattern, printed(executed, named(number)))[1]
        )
