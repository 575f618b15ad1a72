"""Notebooks as they are in git and as they run; they are executed once, on the smallest profile.

An edit of a cell reaches the last table of notebook 8; the cells concerned run in one process.
"""

import ast
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
from dataclasses import replace

import cv2
import nbformat
import numpy as np
import pytest

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import THESIS
from thesis_repro.running.settings import ROOT, read_settings
from thesis_repro.segmentation.prediction import SHIPPED
from thesis_repro.study import lessons

NOTEBOOKS = sorted(path.name for path in (ROOT / "notebooks").glob("*.ipynb"))
TABLES = ["table_3_1", "table_3_2", "table_4_1", "table_4_2", "table_4_3"]
FIGURES = [
    *(f"figure_2_{n:02d}" for n in range(1, 13)),
    *(f"figure_3_{n:02d}" for n in range(1, 7)),
    *(f"figure_4_{n:02d}" for n in range(1, 18)),
    "figure_a_01",
]
WITHOUT_DATA = {*(f"figure_2_{n:02d}" for n in (1, 3, 4, 5, 6, 7)), "figure_3_04", "figure_a_01"}
EXECUTED = re.compile(r"report\.execute notebooks/(\d\d)_")  # in the output of make
# a call that saves a figure, at the start of a line
SAVED = re.compile(r"^(?:style\.save_figure\(|keep\((?:\w+\.)?figure|keep_paths\()", re.MULTILINE)
JUPYTER = ROOT / ".venv" / "bin" / "jupyter-nbconvert"


def cells(name, kind):
    read = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    return ["".join(cell["source"]) for cell in read if cell["cell_type"] == kind]


def execute(name, build, output):
    """Execute a notebook by nbconvert, with no setting of the Makefile but profile and folders."""
    environment = {key: os.environ[key] for key in ("PATH", "HOME", "LANG") if key in os.environ}
    environment |= {
        "PYTHONPATH": str(ROOT),
        "THESIS_REPRO_PROFILE": "smoke",
        "THESIS_REPRO_BUILD": str(build),
        "THESIS_REPRO_FIGURES": str(build.parent / "figures"),
        "IPYTHONDIR": str(build.parent / "ipython"),
    }
    return subprocess.run(
        [
            JUPYTER,
            "--to",
            "notebook",
            "--execute",
            "--ExecutePreprocessor.kernel_name=python3",
            "--output-dir",
            output,
            ROOT / "notebooks" / name,  # or a path of its own
        ],
        env=environment,
        capture_output=True,
        text=True,
    )


def make_figures(tmp_path, *options, root=ROOT):
    # MAKEFLAGS would pass the options of an outer make on to this one
    environment = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("MAKE", "MFLAGS", "THESIS_REPRO_"))
    }
    return subprocess.run(
        [
            "make",
            "figures",
            "PROFILE=smoke",
            f"BUILD={tmp_path / 'build'}",
            f"FIGURES={tmp_path / 'figures'}",
            "-o",
            ".venv/ready",
            *options,
        ],
        cwd=root,
        env=environment | {"PYTHONPATH": str(root)},
        capture_output=True,
        text=True,
    )


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """A folder with build and figures of a run in which every notebook was executed."""
    folder = tmp_path_factory.mktemp("run")
    run = folder / "build" / "embedded-smoke"
    run.mkdir(parents=True)
    (run / "checked").touch()  # as if make had checked the data
    # executed by every kernel
    startup = folder / "ipython" / "profile_default" / "startup" / "watch.py"
    startup.parent.mkdir(parents=True)
    startup.write_text(
        f"import sys\nsys.path.append({str(ROOT / 'tests')!r})\nfrom drawn import watch\n"
        f"watch(get_ipython(), {str(folder / 'faults.txt')!r})\n"
    )
    for name in NOTEBOOKS:
        done = execute(name, folder / "build", run / "notebooks")
        assert done.returncode == 0, done.stderr[-3000:]
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
    done = execute("02_augmentation.ipynb", tmp_path / "build", tmp_path)
    assert done.returncode != 0 and "01_load_images_and_labels" in done.stderr


@pytest.mark.notebooks
@pytest.mark.parametrize(
    "changed, again",
    [
        ("notebooks/06_keypoint_masks.ipynb", ["06", "07", "08", "09"]),
        ("notebooks/07_visual_odometry.ipynb", ["07", "08", "09"]),
        ("thesis_repro/masks.py", [name[:2] for name in NOTEBOOKS]),
        ("street_world/street.py", [name[:2] for name in NOTEBOOKS]),
        ("notebooks/drawing/chapter4.py", [name[:2] for name in NOTEBOOKS]),
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
def test_a_failing_notebook_does_not_stop_the_others(tmp_path):
    """On a copy of the project with two small notebooks."""
    root = tmp_path / "project"
    for folder in ("thesis_repro", "street_world", "notebooks/drawing"):
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
    results = tmp_path / "build" / "embedded-smoke" / "notebooks"
    assert "raise ValueError" in (results / "02_two.log").read_text()
    # hidden ones included
    assert sorted(path.name for path in results.glob("*.ipynb")) == ["01_one.ipynb"]


@pytest.mark.notebooks
def test_real_frames_alone_need_no_training(tmp_path, tiny_kitti):
    planned = make_figures(tmp_path, f"KITTI={tiny_kitti}", "-n")
    assert planned.returncode == 0, planned.stderr
    assert EXECUTED.findall(planned.stdout.replace("\\\n", "")) == [
        "03",
        "05",
        "06",
        "07",
        "08",
        "09",
    ]


@pytest.mark.torture
def test_real_frames_alone_train_and_render_nothing(tmp_path, small_world):
    """On frames of the small world, given as if they were real."""
    done = make_figures(tmp_path, f"KITTI={small_world / 'kitti'}", "WIDTHS=5,10", "REPETITIONS=1")
    assert done.returncode == 0, done.stdout + done.stderr
    # no world is rendered
    (build,) = (path for path in (tmp_path / "build").iterdir() if path.is_dir())
    assert (
        build.name.endswith("-smoke-widths-5_10-repetitions-1") and not (build / "model").exists()
    )
    figures = {
        path.stem
        for path in (tmp_path / "figures" / build.name).iterdir()
        if path.suffix in (".svg", ".webp")
    }
    left_out = {"figure_4_01", "figure_4_02", *(f"figure_3_{n:02d}" for n in (1, 2, 3, 5))}
    assert set(FIGURES) - figures == left_out


@pytest.mark.notebooks
def test_bad_data_stops_before_the_notebooks(tmp_path, tiny_kitti):
    (tiny_kitti / "poses" / "00.txt").unlink()
    failed = make_figures(tmp_path, f"KITTI={tiny_kitti}")
    assert failed.returncode != 0 and "poses/00.txt" in failed.stderr
    assert not list((tmp_path / "build").rglob("*.ipynb"))
    assert "PROFIL: unknown setting" in make_figures(tmp_path, "PROFIL=smoke").stderr


def assigned(code):
    """{name: value} of all assignments as text; assignments of tuples are split."""
    values = {}
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            values |= dict(
                zip(
                    map(ast.unparse, node.targets[0].elts),
                    map(ast.unparse, node.value.elts),
                    strict=True,
                )
            )
        elif isinstance(node, ast.Assign):
            values[node.targets[0].id] = ast.unparse(node.value)
    return values


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_the_last_cell_resets_all_knobs(name):
    (knobs,), last = (
        [code for code in cells(name, "code") if code.startswith("# EDIT HERE: knobs")],
        cells(name, "code")[-1],
    )
    assert assigned(last) == assigned(knobs) | {"PUT_BACK": "False"}


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_cells_are_short(name):
    assert statistics.median(len(code.splitlines()) for code in cells(name, "code")) <= 8


def test_cells_that_lessons_edit_say_so():
    edited = [(number, old) for number, old, *_ in WRONG_KNOBS]
    edited += [
        ("04", "total_loss = dice_loss"),
        ("04", "keras.optimizers.Adam("),
        ("07", "prob=0.999"),
    ]
    edited += [
        ("02", "A.HorizontalFlip(p=0.5)"),
        ("03", "def build_unet("),
        ("09", "np.log1p(change"),
    ]
    unmarked = []
    for number, old in edited:
        (name,) = (name for name in NOTEBOOKS if name.startswith(number))
        found = [code for code in cells(name, "code") if old in code]
        assert found, (number, old)
        if not any(code.startswith("# EDIT HERE: ") for code in found):
            unmarked.append((number, old))
    assert unmarked == []


SLIDERS = """
import re
from thesis_repro.report import style
show, SHOWN = style.with_sliders, []
def watched(draw, **sliders):
    SHOWN.append((draw, sliders))
    show(draw, **sliders)
style.with_sliders = watched
"""
MOVED = """
for draw, sliders in SHOWN:
    for slider in sliders.values():
        if hasattr(slider, "step"):  # a browser rounds a value that no step reaches
            steps = (slider.value - slider.min) / slider.step
            assert abs(steps - round(steps)) < 1e-9, slider
    figure = draw(**{name: slider.value for name, slider in sliders.items()})
    texts = [text for axes in figure.axes for text in (axes.title, *axes.texts)]
    print("SLIDER", "; ".join(text.get_text() for text in texts))
"""


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
def test_sliders_show_the_numbers_of_the_cells_above_after_all_cells(
    executed, tmp_path, number, numbers
):
    """With all cells run, the sliders' functions are called again, where the sliders stand."""
    (path,) = (ROOT / "notebooks").glob(f"{number}_*.ipynb")
    notebook = nbformat.read(path, 4)
    notebook.cells = [
        nbformat.v4.new_code_cell(SLIDERS),
        *notebook.cells,
        nbformat.v4.new_code_cell(MOVED),
    ]
    (tmp_path / "drawing").symlink_to(ROOT / "notebooks" / "drawing")
    nbformat.write(notebook, tmp_path / path.name)
    done = execute(tmp_path / path.name, executed / "build", tmp_path / "out")
    assert done.returncode == 0, done.stderr[-3000:]
    *above, last = nbformat.read(tmp_path / "out" / path.name, 4).cells
    text = "".join(output.get("text", "") for output in last["outputs"])
    (shown,) = re.findall("^SLIDER (.*)$", text, re.MULTILINE)
    before = "\n".join(
        cell["source"] * (cell["cell_type"] == "markdown")
        + "".join(output.get("text", "") for output in cell.get("outputs", ()))
        for cell in above
    )
    for of_cells, of_slider in numbers.items():
        assert re.search(of_slider, shown)[1] == re.search(of_cells, before)[1], shown


def test_the_makefile_lists_the_notebooks_that_each_one_needs():
    listed = dict(
        re.findall(r"^NEEDS_(\d\d) :=(.*)$", (ROOT / "Makefile").read_text(), re.MULTILINE)
    )
    earlier = {}
    for number, needs in sorted(listed.items()):
        earlier[number] = {*needs.split()}.union(*(earlier[need] for need in needs.split()))
    needed = {
        name[:2]: set(re.findall(r'"(\d\d)_\w+"', "\n".join(cells(name, "code")))) - {name[:2]}
        for name in NOTEBOOKS
    }
    assert listed.keys() == needed.keys() and sum(map(len, needed.values())) > 10
    assert [number for number, names in needed.items() if names - earlier[number]] == []


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebooks_in_git_have_no_outputs_and_set_what_libraries_read(name):
    in_git = json.loads((ROOT / "notebooks" / name).read_text())["cells"]
    assert not any(cell.get("outputs") or cell.get("execution_count") for cell in in_git)
    first = cells(name, "code")[0]
    assert (
        name > "08"
        or "%env SM_FRAMEWORK=tf.keras" in first
        and "from thesis_repro import segmentation" in first
    )


def test_every_call_of_the_appendix_is_in_the_notebook_that_the_table_names():
    table = (ROOT / "docs" / "appendix-calls.md").read_text()
    rows = re.findall(r"^\|[^|]*\|(?: `[^|]*` \|)? (\d\d) \| `([^|]*)` \|", table, re.MULTILINE)
    code = {name[:2]: "\n".join(cells(name, "code")) for name in NOTEBOOKS}
    assert len(rows) > 70
    # as a reader's search finds it
    assert [row for row in rows if row[1] not in code[row[0]]] == []


# Edits of cells

# the cells that edits go through, without those that only show something
CELLS = {
    "01": "02 28 03 29 09 30 31 11 32 13 15 21 25 34",
    "02": "02 20 03 21 04 06 22 23 08 24 29 17 30",
    "03": "02 32 03 30 15 17 19 34 27 31",
    "04": "02 27 28 03 29 05 30 06 08 12 31 14 16 32 33 18 34 26",
    "05": "02 39 03 40 05 43 17 45 37",
    "06": "02 36 03 37 04 38 08 40 47 48 26",
    "07": "02 58 03 04 59 75 60 12 14 16 24 65 26 67 68 69",
    "08": "01 34 44 02 03 45 35 48 38 39 56 40 54 55 41 32 43",
}
ALWAYS = {
    "04": {"LIVE_CURVES = True": "LIVE_CURVES = False"},
    "08": {"NAMES = None": 'NAMES = ["00"]'},
}


def code(number, edits):
    """Code of the cells of a notebook, with edits {number: {old text: new text}}."""
    (path,) = (ROOT / "notebooks").glob(f"{number}_*.ipynb")
    sources = [
        "".join(cell["source"])
        for cell in json.loads(path.read_text())["cells"]
        if cell["id"].removeprefix(f"{number}-") in CELLS[number].split()
    ]
    assert len(sources) == len(CELLS[number].split())
    text = "\n".join(["from thesis_repro import segmentation", *sources])
    for old, new in (ALWAYS.get(number, {}) | edits.get(number, {})).items():
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    return text


def environment(world, build):
    return {
        f"THESIS_REPRO_{name}": str(value)
        for name, value in {
            "PROFILE": "smoke",
            "KITTI": world / "kitti",
            "CITYSCAPES": world / "cityscapes",
            "BUILD": build,
        }.items()
    }


def run(world, build, *texts):
    threads = code("04", {}).split("# EDIT HERE")[
        0
    ]  # TensorFlow takes them only before its first use
    paths = (
        f"{ROOT}{os.pathsep}{ROOT / 'notebooks'}"  # a kernel starts in the folder of its notebook
    )
    settings = environment(world, build) | {"PYTHONPATH": paths, "MPLBACKEND": "agg"}
    return subprocess.run(
        [sys.executable, "-"],
        input="\n".join([threads, *texts]),  # too long for an argument
        env=os.environ | settings,
        capture_output=True,
        text=True,
    )


def tables(world, build, numbers, edits):
    """The last table of notebook 8 after each edit, {attempt: {error: row}}."""
    texts = []
    for edit in edits:
        texts += [code(number, edit) for number in [*numbers, "06", "07", "08"]]
        texts.append("print('TABLE', table.to_json(orient='records'))")
    done = run(world, build, *texts)
    assert done.returncode == 0, done.stderr[-3000:]
    printed = [line for line in done.stdout.splitlines() if line.startswith("TABLE ")]
    found = []
    for line in printed:
        found.append({})
        for row in json.loads(line[6:]):
            found[-1].setdefault(row["attempt"], {})[row["error"]] = row
    return found


def use_label_maps(world, label_maps, build):
    """Copy label maps to where notebook 5 writes them, with its record."""
    folder = read_settings(environment(world, build)).build
    shutil.copytree(label_maps, folder / "labels")
    lessons.finish(folder, "05_prediction", {}, {"labels": "of the tests"})
    return folder


def test_edits_of_masks_and_odometry_are_rows_of_the_last_table(
    small_world, small_labels, tmp_path
):
    use_label_maps(small_world, small_labels, tmp_path)
    edits = {
        "as the thesis's": {},
        "06, canny=[1, 3]": {"06": {"CANNY = (5, 15)": "CANNY = (1, 3)"}},
        "06, classes=['road']": {"06": {'"canny", ()': '"canny", ("road",)'}},
        "06, dilation_width=5": {"06": {"DILATION_WIDTH = 10": "DILATION_WIDTH = 5"}},
        "06, your mask": {
            "06": {
                "cv2.dilate(edge_image, kernel)": "cv2.dilate(edge_image, kernel, None, None, 2)"
            }
        },
        "07, max_keypoints=500": {"07": {"= 2000, 0.01": "= 500, 0.01"}},
        "07, window=11": {"07": {"LEVELS = 21, 3": "LEVELS = 11, 3"}},
        "07, your loop": {
            "07": {
                "position = position + lengths[number]": "position = position + 2 * lengths[number]"
            }
        },
    }
    first, *_, last = tables(small_world, tmp_path, [], edits.values())
    assert list(first) == ["as the thesis's"] and list(last) == list(edits)
    thesis, canny, classes, width, line, few, window, loop = (
        rows["RMSE"] for rows in last.values()
    )
    assert thesis == first["as the thesis's"]["RMSE"]  # earlier attempts are kept
    keypoints = [row["keypoints"] for row in (classes, thesis, line, canny)]
    assert keypoints == sorted(keypoints) and len({*keypoints}) == 4
    assert width["keypoints"] < thesis["keypoints"] == window["keypoints"] == loop["keypoints"]
    assert few["keypoints"] <= 500
    for error in ("aligned ATE", "rotation error a frame", "RMSE"):
        rows = [rows[error] for rows in last.values()]
        same = [row["all keypoints"] == rows[0]["all keypoints"] for row in rows]
        # a path of twice the length has the same rotations
        doubled = error == "rotation error a frame"
        assert same == [True] * 5 + [False] * 2 + [doubled]
        assert all(row["lowest"] <= row["ratio"] <= row["highest"] for row in rows)
    assert len({row["RMSE"]["ratio"] for row in last.values()}) == 8
    assert loop["all keypoints"] > 3 * thesis["all keypoints"]


class SparseMasks:
    """Edges of a sequence's frames as masks; some are all zero, and some have a few pixels."""

    def __init__(self, sequence):
        self.sequence = sequence

    def __getitem__(self, index):
        mask = cv2.Canny(self.sequence.frame(index), 200, 600)
        if index % 4 == 3:
            mask[:, 100 if index % 8 == 7 else 0 :] = 0
        return mask


def test_the_loop_by_hand_keeps_the_pose_where_the_package_does(small_world):
    sequence = Sequence(small_world / "kitti", "00")
    (path,) = (ROOT / "notebooks").glob("07_*.ipynb")
    by_id = {cell["id"]: "".join(cell["source"]) for cell in json.loads(path.read_text())["cells"]}
    knobs = assigned(by_id["07-03"])
    names = {"np": np, "cv2": cv2, "odometry": odometry, "settings": read_settings({})}
    for knob in ("MAX_KEYPOINTS", "QUALITY", "MIN_DISTANCE", "BLOCK_SIZE", "WINDOW", "LEVELS"):
        names[knob] = ast.literal_eval(knobs[knob])
    names |= {"THRESHOLD": THESIS.threshold, "SCALE_GATE": THESIS.scale_gate}
    K = sequence.intrinsics
    names |= {"focal": np.array([K[0, 0], K[1, 1]]), "center": K[:2, 2]}
    names["STOP"] = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 30, 0.01)
    exec(by_id["07-24"] + "\n\n" + by_id["07-65"], names)
    for masks in (None, SparseMasks(sequence)):
        poses, keypoints = names["path_by_hand"](sequence, masks, shuffle_seed=2)
        result = odometry.run(sequence, replace(THESIS, shuffle_seed=2), masks)
        assert np.array_equal(poses, result.poses)
        assert keypoints == result.frames["detected"].mean()
    assert result.failed > 1


def test_the_readme_s_command_without_make_opens_the_lab():
    command = r"^(THESIS_REPRO_\w+)=(\S+) \.venv/bin/jupyter lab notebooks"
    (setting,) = re.findall(command, (ROOT / "README.md").read_text(), re.MULTILINE)
    assert read_settings(dict([setting])).profile == "lab"


@pytest.mark.torture
def test_edits_of_network_and_loss_are_rows_of_the_last_table(small_world, tmp_path):
    assert run(small_world, tmp_path, code("01", {}), code("02", {})).returncode == 0
    losses = {
        "categorical_crossentropy": "keras.losses.CategoricalCrossentropy()",
        "lambda": "lambda true, predicted: 1 - tf.reduce_mean(true * predicted)",
    }
    edits = {
        "as the thesis's": {},
        "03, DEPTH=3": {"03": {"DEPTH = 4": "DEPTH = 3"}},
        **{
            f"04, loss={name}": {"04": {"= dice_loss_plus_1focal_loss": f"= {loss}"}}
            for name, loss in losses.items()
        },
    }
    *_, last = tables(small_world, tmp_path, ["03", "04", "05"], edits.values())
    assert list(last) == list(edits)
    rows = [rows["RMSE"] for rows in last.values()]
    assert len({row["inputs"] for row in rows}) == len(edits)
    assert len({row["all keypoints"] for row in rows}) == 1
    # a notebook that was left out is named by the next one
    deeper = {"03": {"DEPTH = 4": "DEPTH = 2"}}
    for numbers, left_out in (("035", "04_training"), ("3457", "06"), ("58", "06")):
        texts = [code(f"0{number}", deeper) for number in numbers.lstrip("0")]
        done = run(small_world, tmp_path, *texts)
        last_line = done.stderr.splitlines()[-1]
        assert done.returncode != 0 and f"run {left_out}" in last_line, last_line


@pytest.mark.torture
def test_the_numbers_of_the_loss_are_those_of_the_loss_in_use(small_world, tmp_path):
    """Without Dice in the obvious line, nothing that the notebook prints counts it."""
    assert (
        run(small_world, tmp_path, *(code(each, {}) for each in ("01", "02", "03"))).returncode == 0
    )
    edit = {"04": {"= dice_loss + 1 * focal_loss": "= focal_loss"}}
    done = run(small_world, tmp_path, code("04", edit))
    assert done.returncode == 0, done.stderr[-3000:]
    assert "to the bit: True" not in done.stdout.split("both forms")[0]
    focal = re.search(r"focal (\d\.\d{6}), ", done.stdout)[1]
    assert re.search(rf"loss in use, focal_loss: {focal};", done.stdout)


WRONG_KNOBS = [
    # notebook, its knob, a wrong value, words of the answer
    ("01", "SIZE = settings.sizes.image_size", 'SIZE = "128"', "SIZE='128': must be a whole"),
    (
        "01",
        "VALIDATION_SHARE, RANDOM_STATE = 0.2",
        'VALIDATION_SHARE, RANDOM_STATE = "a"',
        "above 0",
    ),
    ("02", "SEEDS_COMPARED = 20", 'SEEDS_COMPARED = "20"', "SEEDS_COMPARED='20': must be"),
    ("03", "SIZE = settings.sizes.image_size", 'SIZE = "128"', "SIZE='128': must be a whole"),
    ("03", "DEPTH = 4", 'DEPTH = "3"', "DEPTH='3': must be a whole number from 1 to 6"),
    ("03", "DEPTH = 4", "DEPTH = None", "DEPTH=None: must be"),
    ("04", "EPOCHS = settings.sizes.epochs", 'EPOCHS = "3"', "EPOCHS='3': must be"),
    ("04", "EPOCHS = settings.sizes.epochs", "EPOCHS = 2.5", "EPOCHS=2.5: must be"),
    ("04", "RATE = settings.sizes.learning_rate", 'RATE = "0.1"', "LEARNING_RATE='0.1': must be"),
    ("04", "RATE = settings.sizes.learning_rate", "RATE = None", "LEARNING_RATE=None: must be"),
    ("06", 'FRAME = "10", 637', 'FRAME = "10", "637"', "FRAME='637': must be"),
    ("06", 'FRAME = "10", 637', 'FRAME = "10", None', "FRAME=None: must be"),
    ("06", "DILATION_WIDTH = 10", 'DILATION_WIDTH = "10"', "dilation width '10': must be"),
    ("06", 'LABELS = "labels"', "LABELS = None", "05_prediction"),
    ("06", "return edge_image, cv2", "return cv2", "mask_by_hand: returned one value"),
    ("06", "dilate(edge_image, kernel)", "dilate(edge_image, kernel) / 255", "is float64"),
    ("07", "FRAME = None, 1", 'FRAME = None, "1"', "FRAME='1': must be"),
    (
        "07",
        "COMPARED = 40 if settings.kitti_is_embedded else None",
        "COMPARED = 'x'",
        "COMPARED='x'",
    ),
    ("07", "THRESHOLD = 0.0003", 'THRESHOLD = "0.1"', "odometry setting threshold"),
    ("08", "REPETITIONS = settings.sizes.repetitions", "REPETITIONS = '2'", "REPETITIONS='2'"),
    ("01", "VALIDATION_SHARE, RANDOM_STATE = 0.2", "VALIDATION_SHARE, RANDOM_STATE = 2", "0 and 1"),
    ("03", "BASE_FILTERS = settings.sizes.base_filters", "BASE_FILTERS = 0", "BASE_FILTERS=0"),
    ("03", "DEPTH = 4", "DEPTH = 7", "DEPTH=7: must be a whole number from 1 to 6"),
    ("04", "EPOCHS = settings.sizes.epochs", "EPOCHS = 0", "EPOCHS=0"),
    ("04", "BATCH_SIZE = settings.sizes.batch_size", "BATCH_SIZE = 0", "BATCH_SIZE=0"),
    ("05", 'CLASS = "road"', 'CLASS = "street"', "choose one of"),
    ("06", "CANNY = (5, 15)", "CANNY = 5", "canny=5: must be a tuple"),
    ("06", "CANNY = (5, 15)", "CANNY = (5, 15, 20)", "must be two numbers"),
    ("06", "DILATION_WIDTH = 10", "DILATION_WIDTH = -3", "must be a whole number from 1 to"),
    ("06", "DILATION_WIDTH = 10", "DILATION_WIDTH = 2.5", "must be a whole number from 1 to"),
    ("06", "VIEWS = 3", "VIEWS = 0", "VIEWS=0"),
    ("06", '"canny", ()', '"canny", ("sky")', "classes='sky': must be a tuple, such as"),
    ("07", "FRAME = None, 1", "FRAME = None, 0", "FRAME=0: must be a whole number from 1 to 11"),
    ("07", "FRAME = None, 1", "FRAME = None, 637", "FRAME=637"),
    (
        "07",
        "MAX_KEYPOINTS, QUALITY, MIN_DISTANCE, BLOCK_SIZE = 2000",
        "MAX_KEYPOINTS, QUALITY, MIN_DISTANCE, BLOCK_SIZE = 0",
        "MAX_KEYPOINTS=0",
    ),
    ("07", "WINDOW, LEVELS = 21", "WINDOW, LEVELS = 2", "odometry setting window"),
    ("08", 'METRIC = "se3"', 'METRIC = "error"', "choose one of"),
    ("08", 'METRIC = "se3"', "METRIC = []", "METRIC=[]: choose one of"),
]


def test_a_wrong_knob_is_answered_in_one_line(small_world, small_labels, tmp_path):
    build = use_label_maps(small_world, small_labels, tmp_path)
    made = {"labels": "labels", "dilation_width": 10, "settings": {}, "by_hand": None}
    (build / "model").mkdir()
    shutil.copy(SHIPPED, build / "model" / "model.keras")
    # each notebook takes its record back when it begins
    records = (
        "from thesis_repro.study import lessons\nfrom pathlib import Path\n"
        f"def leave():\n    for name in lessons.RECORDS:\n"
        f"        lessons.finish(Path({str(build)!r}), name, {{}}, {{}}, {{}}, {made!r})\n"
    )
    texts = [records] + [
        f"leave()\ntry:\n    exec({code(number, {number: {knob: wrong}})!r}, {{}})\n"
        "except Exception as error:\n    print(f'ANSWER {type(error).__name__}: {error}')"
        for number, knob, wrong, _ in WRONG_KNOBS
    ]
    done = run(small_world, tmp_path, *texts)
    answers = [line for line in done.stdout.splitlines() if line.startswith("ANSWER ")]
    assert len(answers) == len(WRONG_KNOBS), done.stderr[-3000:]
    for (number, _, wrong, words), answer in zip(WRONG_KNOBS, answers):
        assert answer.startswith("ANSWER InputError: ") and words in answer, (number, wrong, answer)


@pytest.mark.torture
def test_wrong_sizes_name_their_knobs(small_world, tmp_path):
    for size, numbers, named in (
        (32, ("01", "02", "03", "04"), "SIZE in notebooks 1 and 3"),
        (40, ["03"], "SIZE=40"),
    ):
        edits = {"03": {"SIZE = settings.sizes.image_size": f"SIZE = {size}"}}
        done = run(small_world, tmp_path, *(code(number, edits) for number in numbers))
        assert done.returncode != 0 and named in done.stderr.splitlines()[-1]
