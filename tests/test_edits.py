"""An edit of a cell reaches the last table of notebook 8; the cells concerned run in one
process.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from thesis_repro.segmentation.prediction import SHIPPED
from thesis_repro.settings import read_settings

ROOT = Path(__file__).resolve().parent.parent
CELLS = {
    "01": "02 03 05 09 11 13 15 25",
    "02": "02 03 04 06 08 17",
    "03": "02 03 30 15 17 19 27 31",
    "04": "02 03 05 06 08 12 16 26",
    "05": "02 03 05 12 17 37",
    "06": "02 03 04 08 10 26",
    "07": "02 03 04",
    "08": "01 34 02 03 35 38 39 40 41 32 42",
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
    threads = code("04", {}).split("# Knobs")[0]  # TensorFlow takes them only before its first use
    settings = environment(world, build) | {"PYTHONPATH": str(ROOT), "MPLBACKEND": "agg"}
    return subprocess.run(
        [sys.executable, "-c", "\n".join([threads, *texts])],
        env=os.environ | settings,
        capture_output=True,
        text=True,
    )


def tables(world, build, numbers, edits):
    """The last table of notebook 8 after each edit, {attempt: row}, and the runs behind it."""
    texts = []
    for edit in edits:
        texts += [code(number, edit) for number in [*numbers, "06", "07", "08"]]
        texts.append("print('TABLE', table.to_json(orient='records'))")
    done = run(world, build, *texts)
    assert done.returncode == 0, done.stderr[-3000:]
    printed = [line for line in done.stdout.splitlines() if line.startswith("TABLE ")]
    return [{row["attempt"]: row for row in json.loads(line[6:])} for line in printed]


def test_edits_of_masks_and_odometry_are_rows_of_the_last_table(
    small_world, small_labels, tmp_path
):
    shutil.copytree(
        small_labels, read_settings(environment(small_world, tmp_path)).build / "labels"
    )
    edits = {
        "as the thesis's": {},
        "canny=[1, 3]": {"06": {"CANNY = (5, 15)": "CANNY = (1, 3)"}},
        "classes=['road']": {"06": {'"canny", ()': '"canny", ("road",)'}},
        "dilation_width=5": {"06": {"DILATION_WIDTH = 10": "DILATION_WIDTH = 5"}},
        "folder=masks_by_hand": {
            "06": {
                "cv2.dilate(edge_image, kernel)": "cv2.dilate(edge_image, kernel, None, None, 2)"
            }
        },
        "max_keypoints=500": {"07": {"= 2000, 0.01": "= 500, 0.01"}},
        "window=11": {"07": {"LEVELS = 21, 3": "LEVELS = 11, 3"}},
    }
    first, *_, last = tables(small_world, tmp_path, [], edits.values())
    assert list(first) == ["as the thesis's"] and list(last) == list(edits)
    thesis, canny, classes, width, line, few, window = last.values()
    assert thesis == first["as the thesis's"]  # earlier attempts are kept
    keypoints = [row["keypoints"] for row in (classes, thesis, line, canny)]
    assert keypoints == sorted(keypoints) and len({*keypoints}) == 4
    assert width["keypoints"] < thesis["keypoints"] == window["keypoints"]
    assert few["keypoints"] <= 500
    name = "RMSE, all keypoints (m)"
    assert [row[name] == thesis[name] for row in last.values()] == [True] * 5 + [False] * 2
    assert all(row["lowest"] <= row["ratio"] <= row["highest"] for row in last.values())
    assert len({row["ratio"] for row in last.values()}) == 7


@pytest.mark.torture
def test_edits_of_network_and_loss_are_rows_of_the_last_table(small_world, tmp_path):
    assert run(small_world, tmp_path, code("01", {}), code("02", {})).returncode == 0
    loss = "= keras.losses.CategoricalCrossentropy()"
    edits = {
        "as the thesis's": {},
        "DEPTH=3": {"03": {"DEPTH = 4": "DEPTH = 3"}},
        "loss=categorical_crossentropy": {"04": {"= dice_loss_plus_1focal_loss": loss}},
    }
    *_, last = tables(small_world, tmp_path, ["03", "04", "05"], edits.values())
    assert list(last) == list(edits)
    assert len({row["label maps"] for row in last.values()}) == 3
    assert len({row["RMSE, all keypoints (m)"] for row in last.values()}) == 1


WRONG_KNOBS = [
    # notebook, its knob, a wrong value, words of the answer
    ("01", "VALIDATION_SHARE, RANDOM_STATE = 0.2", "VALIDATION_SHARE, RANDOM_STATE = 2", "0 and 1"),
    ("03", "BASE_FILTERS = settings.sizes.base_filters", "BASE_FILTERS = 0", "BASE_FILTERS=0"),
    ("03", "DEPTH = 4", "DEPTH = 7", "DEPTH=7: must be a whole number from 1 to 6"),
    ("04", "EPOCHS = settings.sizes.epochs", "EPOCHS = 0", "EPOCHS=0"),
    ("04", "BATCH_SIZE = settings.sizes.batch_size", "BATCH_SIZE = 0", "BATCH_SIZE=0"),
    ("05", 'CLASS = "road"', 'CLASS = "street"', "choose from"),
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
]


def test_a_wrong_knob_is_answered_in_one_line(small_world, small_labels, tmp_path):
    build = read_settings(environment(small_world, tmp_path)).build
    shutil.copytree(small_labels, build / "labels")
    (build / "masks.json").write_text("{}")  # by notebook 6
    (build / "model").mkdir()
    shutil.copy(SHIPPED, build / "model" / "model.keras")
    texts = [
        f"try:\n    exec({code(number, {number: {knob: wrong}})!r}, {{}})\n"
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
