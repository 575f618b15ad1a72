"""An edit of a cell reaches the last table of notebook 8, and a wrong knob is named in one line.

The cells concerned run in one process.
"""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from cells import NOTEBOOKS, assigned, cells

from thesis_repro import odometry
from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import THESIS
from thesis_repro.running.settings import ROOT, read_settings
from thesis_repro.segmentation.prediction import SHIPPED
from thesis_repro.study import lessons

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
            "FRAMES": 6,  # of twelve; the loop by hand takes most of the time
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
    ("07", "FRAME = None, 1", "FRAME = None, 0", "FRAME=0: must be a whole number from 1 to 5"),
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
