"""Every notebook, executed through `make figures` on the smallest profile."""

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
TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
OWN_TABLES = ["answer", "audit", "budget", "controls", "domain_gap", "masks", "widths"]
TIMINGS = ["budget", "overlapped", "seconds"]  # what was measured, in a folder of its own
OWN_FIGURES = ["answer", "answer_sequences", "budget", "controls", "domain_gap", "masks"]
OWN_TEXTS = ["answer_in_words", "findings"]
FIGURES = [*(f"figure_2_{n:02d}" for n in range(1, 13)), *(f"figure_3_{n:02d}" for n in range(1, 7)),
           *(f"figure_4_{n:02d}" for n in range(1, 18)), "figure_a_01"]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}


def make_figures(tmp_path, *options, root=ROOT):
    # make's own variables would hand the outer make's options on to this one
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith(("MAKE", "MFLAGS", "THESIS_REPRO_"))}
    if root != ROOT:
        environment["PYTHONPATH"] = str(root)
    return subprocess.run(["make", "figures", "PROFILE=smoke", f"BUILD={tmp_path / 'build'}",
                           f"FIGURES={tmp_path / 'figures'}", *options],
                          cwd=root, env=environment, capture_output=True, text=True)


def names(folder, suffix):
    return sorted(path.stem for path in folder.rglob(f"*{suffix}"))


@pytest.mark.notebooks
def test_all_notebooks_run_and_leave_every_artefact(tmp_path):
    first = make_figures(tmp_path)
    assert first.returncode == 0, first.stdout + first.stderr
    executed = tmp_path / "build" / "embedded-smoke" / "notebooks"
    assert sorted(path.name for path in executed.glob("*.ipynb")) == NOTEBOOKS
    figures = tmp_path / "figures" / "embedded-smoke"
    assert sorted(names(figures, ".svg") + names(figures, ".webp")) == sorted(FIGURES + OWN_FIGURES)
    assert names(figures, ".csv") == sorted(TABLES + OWN_TABLES + TIMINGS)
    assert names(figures, ".md") == sorted(TABLES + OWN_TABLES + OWN_TEXTS)
    texts = [f"{name}.md" for name in (*TABLES[2:], *OWN_TABLES, *OWN_TEXTS)]
    texts += [path.name for path in figures.iterdir() if path.suffix in (".svg", ".webp")
              and path.stem not in WITHOUT_DATA]
    assert [name for name in texts if b"embedded world" not in (figures / name).read_bytes()] == []
    page = (figures / "index.html").read_text()
    assert "41 of 41" in page and "embedded world" in page
    outputs = "".join(json.dumps(cell.get("outputs", [])) for path in executed.glob("*.ipynb")
                      for cell in json.loads(path.read_text())["cells"])
    assert outputs.count("to the bit: True") >= 10 and "to the bit: False" not in outputs and "EDITED" not in outputs
    assert "Segmentation Models: using" not in outputs and "oneDNN" not in outputs and "frame/s]" not in outputs
    assert len(list(executed.glob("*.html"))) == len(NOTEBOOKS)
    again = make_figures(tmp_path)
    assert again.returncode == 0 and "load_images" not in again.stdout, again.stdout


@pytest.mark.notebooks
@pytest.mark.parametrize(("name", "first"), [("02_augmentation", "01_load_images_and_labels"),
                                             ("07_visual_odometry", "06_keypoint_masks")])
def test_a_notebook_opened_alone_says_which_one_to_run_first(tmp_path, name, first):
    environment = os.environ | {"THESIS_REPRO_PROFILE": "smoke", "THESIS_REPRO_BUILD": str(tmp_path / "build")}
    done = subprocess.run(
        [ROOT / ".venv/bin/jupyter", "nbconvert", "--to", "notebook", "--execute", "--log-level=CRITICAL",
         "--NotebookExporter.default_preprocessors=thesis_repro.report.execute.Execution",
         f"--Execution.log_file={tmp_path / 'log'}", "--output-dir", tmp_path, ROOT / "notebooks" / f"{name}.ipynb"],
        env=environment, capture_output=True, text=True)
    assert done.returncode != 0
    assert f"not there yet; run notebook {first} first" in done.stderr and "Traceback" not in done.stderr


def test_the_order_of_the_notebooks_has_what_each_of_them_asks_for():
    listed = dict(re.findall(r"^NEEDS_(\d\d) :=(.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE))
    before = {}
    for number, needs in sorted(listed.items()):
        before[number] = {*needs.split(), *(other for one in needs.split() for other in before[one])}
    asked = {name[:2]: set(re.findall(r'\\"(\d\d)_\w+\\"', (ROOT / "notebooks" / name).read_text()))
             for name in NOTEBOOKS}
    assert listed.keys() == asked.keys() and sum(map(len, asked.values())) > 10
    assert {number: some - before[number] for number, some in asked.items() if some - before[number]} == {}


@pytest.mark.notebooks
def test_only_what_changed_is_made_again(tmp_path):
    """On a copy of the project with two small notebooks, the second of which fails at first."""
    root = tmp_path / "project"
    shutil.copytree(ROOT / "thesis_repro", root / "thesis_repro", ignore=shutil.ignore_patterns("__pycache__"))
    (root / ".venv").symlink_to(ROOT / ".venv")
    for name in ("Makefile", "environment.txt", "pyproject.toml"):
        shutil.copy(ROOT / name, root)
    (root / "notebooks").mkdir()

    def write(name, code):
        nbformat.write(nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)]), root / "notebooks" / name)

    def make():
        done = make_figures(tmp_path, "-o", ".venv/ready", root=root)
        return done, [name for name in ("01_one", "02_two") if name in done.stdout.splitlines()]

    write("01_one.ipynb", "from thesis_repro.report import style\nprint('by hand')")
    write("02_two.ipynb", "from thesis_repro import InputError\nraise InputError('labels: missing; run notebook 5')")
    failed, executed = make()
    assert failed.returncode != 0 and executed == ["01_one", "02_two"]
    assert "02_two failed: InputError: labels: missing; run notebook 5\nthe whole report: " in failed.stderr
    results = tmp_path / "build" / "embedded-smoke" / "notebooks"
    assert "raise InputError" in (results / "02_two.log").read_text()
    assert sorted(path.name for path in results.glob("*.ipynb")) == ["01_one.ipynb"]  # hidden ones included

    write("02_two.ipynb", "print('mended')")
    assert make()[1] == ["02_two"]
    page = tmp_path / "figures" / "embedded-smoke" / "index.html"
    first = page.stat().st_mtime_ns
    assert make()[1] == [] and page.stat().st_mtime_ns == first
    template = root / "thesis_repro" / "report" / "template.html"
    template.touch()
    assert make()[1] == [] and page.stat().st_mtime_ns == first
    template.write_text(template.read_text() + "<!-- another word -->\n")
    assert make()[1] == [] and page.stat().st_mtime_ns > first
    (root / "thesis_repro" / "report" / "style.py").touch()
    assert make()[1] == ["01_one", "02_two"]


@pytest.mark.notebooks
def test_real_frames_alone_train_and_render_nothing(tmp_path, small_world):
    """On the small world's frames, given as if they were real; one size is not the profile's."""
    kitti = small_world / "kitti"
    done = make_figures(tmp_path, f"KITTI={kitti}", "WIDTHS=5,10", "REPETITIONS=1")
    assert done.returncode == 0, done.stdout + done.stderr
    (build,) = (tmp_path / "build").iterdir()  # no world beside it
    assert build.name.endswith("-smoke-widths-5_10-repetitions-1") and not (build / "model").exists()
    assert [name[:2] for name in names(build / "notebooks", ".ipynb")] == ["03", "05", "06", "07", "08", "09"]
    figures = tmp_path / "figures" / build.name
    left_out = {"figure_4_01", "figure_4_02", *(f"figure_3_{n:02d}" for n in range(1, 6))}
    assert set(names(figures, ".svg") + names(figures, ".webp")) == {*FIGURES, *OWN_FIGURES} - left_out
    page = (figures / "index.html").read_text()
    assert "Nothing was trained" in page and "Missing" not in page and page.count("Left out: it shows") == 9


@pytest.mark.notebooks
def test_bad_data_stops_before_the_notebooks_with_one_line(tmp_path, tiny_kitti):
    (tiny_kitti / "poses" / "00.txt").unlink()
    failed = make_figures(tmp_path, f"KITTI={tiny_kitti}")
    assert failed.returncode != 0 and "poses/00.txt: no such file" in failed.stderr
    assert not list((tmp_path / "build").rglob("*.ipynb"))
    assert "PROFILE=huge: unknown profile" in make_figures(tmp_path, "PROFILE=huge").stderr
    assert "PROFIL: unknown setting" in make_figures(tmp_path, "PROFIL=smoke").stderr


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_hold_no_outputs(name):
    cells = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in cells)
