"""Notebooks as they are in git, and as they run: on the smallest profile, executed once for all that looks at them."""

import ast
import json
import os
import re
import shutil
import subprocess
from pathlib import Path

import nbformat
import pytest

ROOT = Path(__file__).resolve().parent.parent
NOTEBOOKS = sorted(path.name for path in (ROOT / "notebooks").glob("*.ipynb"))
SECTIONS = {"01": "A.2", "02": "A.3", "03": "A.4", "04": "A.5 and A.6", "05": "A.7", "06": "A.8", "07": "3.7"}
TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
FIGURES = [*(f"figure_2_{n:02d}" for n in range(1, 13)), *(f"figure_3_{n:02d}" for n in range(1, 7)),
           *(f"figure_4_{n:02d}" for n in range(1, 18)), "figure_a_01"]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}
EXECUTED = re.compile(r"nbconvert .* --output \.(\d\d)_")  # in what make prints
JUPYTER = ROOT / ".venv" / "bin" / "jupyter-nbconvert"


def cells(name, kind):
    read = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    return ["".join(cell["source"]) for cell in read if cell["cell_type"] == kind]


def execute(name, build, output):
    """Plain nbconvert, with nothing in the environment that the Makefile sets but the profile."""
    environment = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
    environment |= {"PYTHONPATH": str(ROOT), "THESIS_REPRO_PROFILE": "smoke", "THESIS_REPRO_BUILD": str(build),
                    "THESIS_REPRO_FIGURES": str(build.parent / "figures")}
    return subprocess.run([JUPYTER, "--to", "notebook", "--execute", "--ExecutePreprocessor.kernel_name=python3",
                           "--output-dir", output, ROOT / "notebooks" / name],
                          env=environment, capture_output=True, text=True)


def make_figures(tmp_path, *options, root=ROOT):
    # make's own variables would hand the outer make's options on to this one
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(("MAKE", "MFLAGS", "THESIS_REPRO_"))}
    return subprocess.run(["make", "figures", "PROFILE=smoke", f"BUILD={tmp_path / 'build'}",
                           f"FIGURES={tmp_path / 'figures'}", "-o", ".venv/ready", *options],
                          cwd=root, env=environment | {"PYTHONPATH": str(root)}, capture_output=True, text=True)


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """The folder of a run in which every notebook was executed: build and figures."""
    folder = tmp_path_factory.mktemp("run")
    run = folder / "build" / "embedded-smoke"
    run.mkdir(parents=True)
    (run / "checked").touch()  # what `make figures` would otherwise do before a notebook
    for name in NOTEBOOKS:
        done = execute(name, folder / "build", run / "notebooks")
        assert done.returncode == 0, done.stderr[-3000:]
        if name == NOTEBOOKS[0]:
            (run / "drives").touch()  # what it would do beside the training
    return folder


@pytest.mark.notebooks
def test_every_artefact_is_there_and_says_where_its_data_come_from(executed):
    figures = executed / "figures" / "embedded-smoke"
    written = {path.stem: path for path in figures.iterdir() if path.suffix in (".svg", ".webp")}
    assert set(FIGURES) <= written.keys() and len(FIGURES) == 36
    assert all((figures / f"{name}{suffix}").is_file() for name in TABLES for suffix in (".csv", ".md"))
    texts = [written[name] for name in FIGURES if name not in WITHOUT_DATA]
    texts += [figures / f"{name}.md" for name in TABLES[2:]]
    assert [path.name for path in texts if b"embedded world" not in path.read_bytes()] == []


@pytest.mark.notebooks
def test_the_cells_do_what_the_package_does(executed):
    outputs = "".join(json.dumps(cell.get("outputs", [])) for name in NOTEBOOKS for cell in
                      json.loads((executed / "build/embedded-smoke/notebooks" / name).read_text())["cells"])
    assert outputs.count("to the bit: True") >= 10 and "to the bit: False" not in outputs and "EDITED" not in outputs


@pytest.mark.notebooks
def test_make_figures_takes_executed_notebooks_as_they_are(executed):
    done = make_figures(executed)
    assert done.returncode == 0 and not re.findall(r"^\d\d_\w+", done.stdout, re.MULTILINE), done.stdout + done.stderr
    assert "41 of 41" in (executed / "figures" / "embedded-smoke" / "index.html").read_text()


@pytest.mark.notebooks
def test_a_notebook_opened_alone_says_which_one_to_run_first(tmp_path):
    done = execute("02_augmentation.ipynb", tmp_path / "build", tmp_path)
    assert done.returncode != 0 and "01_load_images_and_labels" in done.stderr


@pytest.mark.notebooks
@pytest.mark.parametrize("changed, again", [
    ("notebooks/06_keypoint_masks.ipynb", ["06", "07", "08", "09"]),
    ("notebooks/07_visual_odometry.ipynb", ["07", "08", "09"]),
    ("thesis_repro/masks.py", [name[:2] for name in NOTEBOOKS]), ("thesis_repro/report/page.py", [])])
def test_only_what_changed_is_made_again(executed, changed, again):
    """What make would do, asked of it without doing it."""
    # (the check of the data is always made, and touches its file where the data has changed)
    planned = make_figures(executed, "-n", "-W", changed, "-o", executed / "build" / "embedded-smoke" / "checked")
    assert planned.returncode == 0
    assert EXECUTED.findall(planned.stdout.replace("\\\n", "")) == again, planned.stdout


@pytest.mark.notebooks
def test_a_notebook_that_fails_costs_the_others_nothing(tmp_path):
    """On a copy of the project with two small notebooks."""
    root = tmp_path / "project"
    shutil.copytree(ROOT / "thesis_repro", root / "thesis_repro", ignore=shutil.ignore_patterns("__pycache__"))
    (root / ".venv").symlink_to(ROOT / ".venv")
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, root)
    (root / "notebooks").mkdir()
    for name, code in (("01_one.ipynb", "print('by hand')"), ("02_two.ipynb", "raise ValueError('labels: missing')")):
        nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), root / "notebooks" / name)
    failed = make_figures(tmp_path, root=root)
    assert failed.returncode != 0 and "labels: missing" in failed.stderr
    assert (tmp_path / "figures" / "embedded-smoke" / "index.html").is_file()
    results = tmp_path / "build" / "embedded-smoke" / "notebooks"
    assert "raise ValueError" in (results / "02_two.log").read_text()
    assert sorted(path.name for path in results.glob("*.ipynb")) == ["01_one.ipynb"]  # hidden ones included


@pytest.mark.notebooks
def test_real_frames_alone_ask_for_no_training(tmp_path, tiny_kitti):
    """What make would do, asked of it without doing it."""
    planned = make_figures(tmp_path, f"KITTI={tiny_kitti}", "-n")
    assert planned.returncode == 0, planned.stderr
    assert EXECUTED.findall(planned.stdout.replace("\\\n", "")) == ["03", "05", "06", "07", "08", "09"]


@pytest.mark.torture
def test_real_frames_alone_train_and_render_nothing(tmp_path, small_world):
    """On the small world's frames, given as if they were real; one size is not the profile's."""
    done = make_figures(tmp_path, f"KITTI={small_world / 'kitti'}", "WIDTHS=5,10", "REPETITIONS=1")
    assert done.returncode == 0, done.stdout + done.stderr
    (build,) = (tmp_path / "build").iterdir()  # no world beside it
    assert build.name.endswith("-smoke-widths-5_10-repetitions-1") and not (build / "model").exists()
    figures = {path.stem for path in (tmp_path / "figures" / build.name).iterdir() if path.suffix in (".svg", ".webp")}
    left_out = {"figure_4_01", "figure_4_02", *(f"figure_3_{n:02d}" for n in range(1, 6))}
    assert set(FIGURES) - figures == left_out


@pytest.mark.notebooks
def test_bad_data_stops_before_the_notebooks(tmp_path, tiny_kitti):
    (tiny_kitti / "poses" / "00.txt").unlink()
    failed = make_figures(tmp_path, f"KITTI={tiny_kitti}")
    assert failed.returncode != 0 and "poses/00.txt" in failed.stderr
    assert not list((tmp_path / "build").rglob("*.ipynb"))
    assert "PROFILE=huge" in make_figures(tmp_path, "PROFILE=huge").stderr
    assert "PROFIL: unknown setting" in make_figures(tmp_path, "PROFIL=smoke").stderr


def assigned(code):
    """{name: value} of all assignments, as text; those of tuples one by one."""
    values = {}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            values |= dict(zip(map(ast.unparse, node.targets[0].elts), map(ast.unparse, node.value.elts), strict=True))
        elif isinstance(node, ast.Assign):
            values[node.targets[0].id] = ast.unparse(node.value)
    return values


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_last_cell_puts_all_knobs_back(name):
    (knobs,), last = [code for code in cells(name, "code") if code.startswith("# Knobs")], cells(name, "code")[-1]
    assert assigned(last) == assigned(knobs) | {"PUT_BACK": "False"}


def test_the_order_of_the_notebooks_has_what_each_of_them_asks_for():
    listed = dict(re.findall(r"^NEEDS_(\d\d) :=(.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE))
    before = {}
    for number, needs in sorted(listed.items()):
        before[number] = {*needs.split(), *(earlier for need in needs.split() for earlier in before[need])}
    asked = {name[:2]: set(re.findall(r'"(\d\d)_\w+"', "\n".join(cells(name, "code")))) for name in NOTEBOOKS}
    assert listed.keys() == asked.keys() and sum(map(len, asked.values())) > 10
    assert {number: names - before[number] for number, names in asked.items() if names - before[number]} == {}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_hold_no_outputs(name):
    read = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in read)


@pytest.mark.parametrize("name", [name for name in NOTEBOOKS if name[:2] in SECTIONS])
def test_a_notebook_says_what_it_mirrors_and_sets_what_libraries_read(name):
    assert SECTIONS[name[:2]] in cells(name, "markdown")[0] and "**Written:**" in cells(name, "markdown")[-1]
    first, *others = cells(name, "code")
    assert "%env SM_FRAMEWORK=tf.keras" in first and "%env NO_ALBUMENTATIONS_UPDATE=1" in first


def test_every_call_of_the_appendix_is_where_the_table_says():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\|[^|]*\|(?: `[^|]*` \|)? (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    code = {name[:2]: "\n".join(cells(name, "code")) for name in NOTEBOOKS}
    assert len(rows) > 70 and [row for row in rows if row[1] not in code[row[0]]] == []
