"""Every exercise of the notebooks shows what it promises.

The cells that an edit goes through run in this process, on the small world and its exact label
maps. What holds only in the lab is marked torture.
"""

import json
import operator
import re
import shutil
from collections import defaultdict
from contextlib import redirect_stdout
from io import StringIO

import cv2
import matplotlib.pyplot as plt
import numba
import numpy as np
import pandas as pd
import pytest
from cells import NOTEBOOKS, cells, named
from scipy import stats

import thesis_repro as tr
from keypoint_study import comparisons, ratios
from thesis import artefacts, audit_of_tables, earlier, section_4_2
from thesis.settings import PREFIX, ROOT, read_settings
from thesis_repro import masks
from thesis_repro.data import cityscapes
from thesis_repro.errors import InputError
from thesis_repro.running import provenance

# the cells that an edit goes through, without those that only show something
READING = "02 28 03 09 30 31 36 11 32 13 15"
TRANSFORMS = "02 20 03 04 06 22 23"
NETWORK = "01 02 32 03 15 17 39 19 34"
LOSS = "01 02 27 03 05 06 08 43 45 60 62"
LOSSES = f"{LOSS} 39 47 40 41"
FIRST = "01 02 03 05 06 52"  # of notebook 6
MASKS = f"{FIRST} 08 09 12 13 46 47 48"
PREDICTION = "01 02 03 04 06 07 41 14 15 23"
LOOP = "01 02 03 04 06 15 18 23 24 39 40 43 44 52 60 80"
CHOICES = "01 02 03 04 23 52 43 54 55"
TEXT = "aligned ATE (m)"
CROSS_ENTROPY = "other_loss = keras.losses.CategoricalCrossentropy()"
ALL_SEQUENCES = "kitti.sequences(settings.kitti)"
WINDOW_OF_5 = "WINDOW = 21 ", "WINDOW = 5 "
SKY = "classes=(),", 'classes=("sky",),'
ROTATION = "rotation error (°/frame)"


def run(number, ids, *edits, **names):
    """The names that cells of a notebook leave, and "printed", what they print.

    edits: pairs of an old and a new text.
    """
    by_id = cells(named(number), "code")
    text = "\n\n".join(by_id[f"{number}-{each}"] for each in ids.split())
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    with redirect_stdout(StringIO()) as printed:
        exec(re.sub("(?m)^%", "#", text), names)
    return names | {"printed": printed.getvalue()}


def parameters(names):
    return names["model"].count_params()


def fall_of_loss(names):
    losses = names["history1"].history["loss"]
    return losses[0] - losses[-1]


# exercise: (cells, an old and a new text, what is looked at, what holds of it before and after)
BEFORE_AND_AFTER = {
    "01_1": (
        READING,
        ("LABEL_RESIZING = cv2.INTER_NEAREST", "LABEL_RESIZING = cv2.INTER_LINEAR"),
        lambda names: set(np.unique(names["labels"])),
        operator.lt,
    ),
    "01_3": (  # what Figure 3.5 counts stays
        READING,
        ("VALIDATION_SHARE = 0.2", "VALIDATION_SHARE = 0.5"),
        lambda names: (len(names["validation_images"]), names["labels"].tolist()),
        lambda usual, edited: usual[0] < edited[0] and usual[1] == edited[1],
    ),
    "02_1": (
        TRANSFORMS,
        ("A.HorizontalFlip(p=0.5)", "A.VerticalFlip(p=0.5)"),
        lambda names: "EDITED" in names["printed"],
        operator.lt,
    ),
    "03_1": (  # and Figure A.1
        f"{NETWORK} 21",
        ("DEPTH = 4 ", "DEPTH = 3 "),
        lambda names: (parameters(names), names["table"]["as printed"].sum()),
        lambda usual, edited: (
            edited[0] == pytest.approx(0.25 * usual[0], rel=0.1) and edited[1] < usual[1] == 41
        ),
    ),
    "03_2": (
        NETWORK,
        ("CORRECTED_BLOCKS = False", "CORRECTED_BLOCKS = True"),
        parameters,
        lambda usual, edited: edited == pytest.approx(2 * usual, rel=0.1),
    ),
    "04_3": (
        LOSS,
        ("LEARNING_RATE = settings.sizes.learning_rate", "LEARNING_RATE = 0.00001"),
        fall_of_loss,
        lambda usual, edited: 0 < edited < usual / 4,
    ),
}
# exercise: (an old and a new text, what masks.json holds beside the width of 10, what holds of the
# reader's row of the last table of notebook 6 as a ratio to the thesis's)
YOUR_MASKS = {
    "06_1": (
        ("CANNY = (5, 15)", "CANNY = (1, 3)"),
        {"canny": [1, 3]},
        lambda row: row["coverage (%)"] > 1.05 and row["keypoints"] > 1,
    ),
    "06_2": (
        SKY,
        {"classes": ["sky"]},
        lambda row: row["keypoints"] < 0.25 and row[ROTATION] > 1,
    ),
    "06_3": (
        ("WIDTH = 10 ", "WIDTH = 3 "),
        {"width": 3},
        lambda row: row["coverage (%)"] < row["keypoints"] < 1,
    ),
    "06_3, inverse": (
        ('keep="boundaries"', 'keep="inverse"'),
        {"keep": "inverse"},
        lambda row: row["keypoints"] > 1,
    ),
    "06_4": (
        ("dilate(edge_image, kernel)", "dilate(edge_image, kernel, None, None, 2)"),
        {},
        lambda row: row["coverage (%)"] > 1.2,
    ),
}
# the same of notebook 7, and whether its cell prints EDITED
YOUR_LOOP = {
    "07_2": (WINDOW_OF_5, False, lambda row: row["tracked (%)"] < 0.95),
    "07_4": (
        ('"maxLevel": 3', '"maxLevel": 0'),
        True,
        lambda row: row["tracked (%)"] > 1 and row[ROTATION] > 5,
    ),
    "07_4, the position": (
        ("position + scales[number]", "position + 2 * scales[number]"),
        True,
        lambda row: row[TEXT] > 10,
    ),
}


@pytest.fixture
def choose(tmp_path, monkeypatch):
    """A function that sets settings of a run in a folder of its own."""

    def set_variables(**settings):
        for name, value in ({"BUILD": tmp_path} | settings).items():
            monkeypatch.setenv(PREFIX + name, str(value))

    return set_variables


@pytest.fixture
def build(small_world, small_labels, choose):
    """The folder of a run on the small world, with the label maps of notebook 5."""
    world = {"KITTI": small_world / "kitti", "CITYSCAPES": small_world / "cityscapes"}
    choose(PROFILE="smoke", FRAMES=5, **world)
    read_settings().build.mkdir(parents=True)
    (read_settings().build / "labels").symlink_to(small_labels)
    return read_settings().build


@pytest.fixture
def images(build):
    """The same, with the arrays of notebook 1."""
    run("01", f"{READING} 25")
    return build


@pytest.fixture
def networks(images):
    """The same, with the arrays of notebook 2 and the network of notebook 3."""
    run("02", f"{TRANSFORMS} 32 08 24 29 17 34")
    run("03", f"{NETWORK} 27")
    return images


def test_every_exercise_has_a_test():
    asked = set()
    for name in NOTEBOOKS:
        (text,) = (each for each in cells(name, "markdown").values() if "## Exercises" in each)
        questions = text.partition("## Exercises")[2].partition("<details")[0]
        asked |= {(name[:2], number) for number in re.findall(r"(?m)^(\d)\. ", questions)}
    tests = filter(re.compile("test").match, globals())
    tables = (*BEFORE_AND_AFTER, *YOUR_MASKS, *YOUR_LOOP)
    tested = re.findall(r"(?:\b|(?<=_))(\d\d)_(\d)", " ".join([*tests, *tables]))
    assert asked == set(tested)


@pytest.mark.parametrize("exercise", BEFORE_AND_AFTER)
def test_an_edit_has_the_promised_effect(exercise, request):
    number = exercise[:2]
    request.getfixturevalue({"02": "images", "04": "networks"}.get(number, "build"))
    ids, edit, look, holds = BEFORE_AND_AFTER[exercise]
    usual, edited = look(run(number, ids)), look(run(number, ids, edit))
    assert holds(usual, edited)


def test_exercise_01_2(build):
    from thesis_repro.segmentation import training

    share, dots = {}, {}
    for size in (64, 32):
        knob = "SIZE = settings.sizes.image_size", f"SIZE = {size}"
        names = run("01", READING, knob)
        poles = names["labels"] == cityscapes.ID["pole"]
        beside = poles[:, 1:] & poles[:, :-1]  # a pole is upright: the pixel below is one, too
        share[size], dots[size] = poles.mean(), 1 - beside.sum() / poles.sum()
    assert share[32] == pytest.approx(share[64], rel=0.3) and dots[32] > 1.3 * dots[64]
    with pytest.raises(InputError, match="32.*64"):
        training.check_images(names["train_images"], (None, 64, 64, 1))


def test_exercise_02_2(images):
    written = []
    full = "FULL_VALIDATION_AUGMENTATION = False", "FULL_VALIDATION_AUGMENTATION = True"
    for edit in ((), [full]):
        run("02", f"{TRANSFORMS} 32 08 24 29 17 34", *edit)
        files = sorted((images / "data").glob("doubled_*"))
        written.append({file.stem: file.read_bytes() for file in files})
    same = {name for name in written[0] if written[0][name] == written[1][name]}
    assert same == {"doubled_train_images", "doubled_train_labels"}


def test_exercise_02_3(images):
    edit = "SEEDS_COMPARED = 20 ", "SEEDS_COMPARED = 200 "
    printed = run("02", f"{TRANSFORMS} 15 27", edit)["printed"]
    assert re.search(r"(?m)^0 of [\d,]+ values differ over 200 seeds", printed)


def test_exercise_03_3(build):
    with pytest.raises(InputError, match="100.*16"):
        run("03", NETWORK, ("SIZE = settings.sizes.image_size", "SIZE = 100"))


@pytest.mark.torture
def test_exercise_04_2(networks):
    same = run("04", LOSSES, (CROSS_ENTROPY, "other_loss = total_loss"))
    first, second = (same[name].history for name in ("history1", "history2"))
    assert len(second) == 3 and second == {name: first[name] for name in second}
    assert same["scores"]["total_loss"] == same["scores"]["other_loss"]


@pytest.mark.torture
def test_exercise_04_1(choose):
    """In the lab: the cross-entropy is ahead after two and four epochs, not after six."""
    choose(PROFILE="lab")
    run("01", READING.replace("03", "03 05") + " 25")
    run("02", f"{TRANSFORMS} 32 08 24 29 17 34")
    run("03", f"{NETWORK} 27")
    ahead = []
    for epochs in (2, 4, 6):
        scores = run("04", LOSSES, ("EPOCHS = 2 ", f"EPOCHS = {epochs} "))["scores"]
        ahead.append(max(scores, key=scores.get))
    assert ahead == ["other_loss", "other_loss", "total_loss"]


def test_exercise_05_1(build):
    _, labels = cityscapes.load(cityscapes.pairs(read_settings().cityscapes, "val"), 64)
    moved = []
    for name in ("building", "traffic sign", "pole"):
        label = cityscapes.LABELS[cityscapes.ID[name]]
        printed = run("05", "56", np=np, test_labels=labels, label=label)["printed"]
        moved.append(float(re.search(r"IoU ([\d.]+)", printed)[1]))
    building, sign, pole = moved
    assert building > 0.7 > 1.5 * sign and sign > pole


@pytest.mark.notebooks
def test_exercise_05_2(executed, small_world, choose):
    """The model in the package is ahead, and its masks keep more of the true boundaries."""
    build = executed / "build/embedded-smoke"
    columns = pd.read_csv(build / "figures/domain_gap.csv").set_index("measure").astype(float)
    own, package = (columns.filter(like=text) for text in ("of this run", "in the package"))
    assert (package.loc["pixel accuracy"].to_numpy() > own.loc["pixel accuracy"].to_numpy()).all()
    choose(KITTI=small_world / "kitti", FRAMES=5)
    earlier.label_maps()
    kept = []
    sequence = tr.Sequence(small_world / "kitti", "00")
    true = cv2.imread(str(sequence.folder / "labels_0" / sequence.frame_paths[0].name), 0)
    for labels in (build, read_settings().build):
        made = tr.LabelMasks(labels / "labels/00", sequence.subset(5), 10)[0]
        kept.append(masks.boundaries_found(made, true))
    assert kept[1] > 1.1 * kept[0]


def rows_of(number, ids, *edits):
    """The thesis's row and the reader's in the last table of a notebook, and what it prints."""
    names = run(number, ids, *edits)
    rows = names["rows"]
    thesis, yours = (rows if number == "06" else pd.DataFrame(rows).T).iloc
    return thesis, yours, names["printed"]


def test_your_masks_stand_beside_the_thesiss(build):
    thesis, yours, printed = rows_of("06", MASKS)
    assert thesis.equals(yours) and thesis["keypoints"] > 100
    assert "to the bit: True" in printed and "EDITED" not in printed
    assert json.loads((build / "masks.json").read_text()) == {"width": 10}
    for exercise, (edit, settings, holds) in YOUR_MASKS.items():
        first, yours, printed = rows_of("06", MASKS, edit)
        assert first.equals(thesis) and holds(yours / thesis), exercise
        assert ("EDITED" in printed) == (settings == {}), exercise
        written = json.loads((build / "masks.json").read_text())
        assert written == {"width": 10} | settings, exercise


def test_answers_run_when_somebody_asks_for_them(build):
    ids = f"{FIRST} 08 09 12 13 46 50"
    waiting = run("06", ids)
    assert waiting["runs"] == {} and not waiting["RUN_ANSWERS"]
    assert len(run("06", ids, ("RUN_ANSWERS = False", "RUN_ANSWERS = True"))["runs"]) == 5


def test_notebooks_6_and_7_can_be_opened_first(build):
    (build / "labels").unlink()
    printed = run("07", "01 02 03 04 06")["printed"]
    assert "masks: {'width': 10}" in printed and "not the thesis's" not in printed
    assert len(list((build / "labels").glob("*/*.png"))) == 10
    assert artefacts.data_note().endswith("label maps: by the model in the package")
    shutil.rmtree(build / "labels")
    run("06", FIRST)
    assert len(list((build / "labels").glob("*/*.png"))) == 10


def test_what_a_lesson_that_is_opened_first_makes_are_the_bits_of_earlier_lessons(networks):
    written = sorted([*networks.glob("data/*.npy"), networks / "network.keras"])
    before = [path.read_bytes() for path in written]
    assert len(written) == 11
    shutil.rmtree(networks / "data")
    weights = training_weights(networks / "network.keras")
    (networks / "network.keras").unlink()
    run("04", "01 02 27 03 05")
    assert [path.read_bytes() for path in written[:-1]] == before[:-1]
    assert training_weights(earlier.network()) == weights


def training_weights(path):
    """The digest of the weights of a network."""
    from thesis_repro.segmentation import training

    return training.weights_digest(training.load_model(path))


def test_a_cell_that_compiles_says_so_once(capsys, monkeypatch):
    monkeypatch.setattr(numba.core.event, "_registered", defaultdict(list))  # begun before or not
    artefacts.say_that_it_compiles.cache_clear()
    artefacts.say_that_it_compiles()
    for number in (1, 2):
        numba.njit(lambda x, number=number: x + number)(number)
    assert capsys.readouterr().out.count("compiling") == 1


def test_notebook_9_says_whose_runs_it_reads(build, small_model):
    assert "real streets" in run("09", "14", earlier=earlier)["printed"]
    labels, settings = build / "labels", {"run": {"masks": ["label maps"]}}
    labels.unlink()
    earlier.label_maps()
    digest = provenance.digest_of_files(sorted((labels / "00").glob("*.png")))
    settings["run"]["files"] = digest
    (build / "odometry/00").mkdir(parents=True)
    (build / "odometry/00/settings.json").write_text(json.dumps(settings))
    for name in ("runs.csv", "shuffled_runs.csv"):
        shutil.copy(earlier.EVIDENCE / name, build)
    assert earlier.results()[2] == "this run, label maps: by the model in the package"
    (build / "model").mkdir()
    shutil.copy(small_model, build / "model")
    run("05", PREDICTION)  # replaces the label maps
    whose = earlier.results()[2]
    assert "by the model in the package (replaced since" in whose


def label_maps_by(*edits):
    """The model with which notebook 5 makes label maps, and what figures say about them."""
    names = run("05", PREDICTION, *edits)
    assert artefacts.used_model().input_shape == names["model"].input_shape
    assert artefacts.data_note() == names["note"]
    return names["whose"], names["model"].input_shape[1], names["note"]


def test_label_maps_are_of_the_model_that_notebook_5_names_in_any_order(images, small_model):
    (images / "labels").unlink()
    run("06", FIRST)  # opened first
    assert label_maps_by()[0] == "the model in the package"  # notebook 4 was not run
    assert artefacts.data_note().endswith("label maps: by the model in the package")
    (images / "model").mkdir()
    shutil.copy(small_model, images / "model")
    own = "the model of this run", 64, read_settings().data_note
    package = "the model in the package", 320, f"{own[2]}; label maps: by the model in the package"
    shipped = "SHIPPED = not artefacts.is_trained()", "SHIPPED = True"
    ways = [label_maps_by(), label_maps_by(shipped), label_maps_by()]
    assert ways == [own, package, own]
    run("06", FIRST)  # leaves the label maps of notebook 5
    assert artefacts.data_note() == own[2]


def test_label_maps_of_an_earlier_training_or_of_two_networks_are_named(images, small_model):
    folder = images / "model"
    folder.mkdir()
    shutil.copy(small_model, folder)
    (images / "labels").unlink()
    label_maps_by()
    again = artefacts.model_of_run()
    again.set_weights([weights + 0.1 for weights in again.get_weights()])
    again.save(folder / "model.keras")
    with pytest.raises(InputError, match="labels.*05_prediction"):
        artefacts.used_model()
    shutil.rmtree(images / "labels/00")  # as if notebook 5 was stopped after its first sequence
    provenance.stage(images / "labels/00", model="another")
    for opened in (lambda: run("06", FIRST), artefacts.used_model, artefacts.data_note):
        with pytest.raises(InputError, match="labels.*two networks.*05_prediction"):
            opened()
    assert [label_maps_by()[0] for _ in range(2)] == ["the model of this run"] * 2


def test_label_maps_by_the_model_in_the_package_are_made_to_the_end(build):
    (build / "labels").unlink()
    earlier.label_maps()
    maps = sorted((build / "labels").glob("*/*.png"))
    before = [path.read_bytes() for path in maps]
    for path in maps[3:]:  # as if the notebook was stopped
        path.unlink()
    earlier.label_maps()
    assert [path.read_bytes() for path in maps] == before and len(before) == 10


def test_your_loop_stands_beside_the_thesiss(build):
    run("06", MASKS)
    thesis, yours, printed = rows_of("07", LOOP)
    assert thesis.round(9).equals(yours.round(9)) and thesis["keypoints"] > 1000
    assert "masks: {'width': 10}" in printed and "not the thesis's" not in printed
    assert "EDITED" not in printed
    for exercise, (edit, is_marked, holds) in YOUR_LOOP.items():
        first, yours, printed = rows_of("07", LOOP, edit)
        assert first.equals(thesis) and holds(yours / thesis), exercise
        assert ("EDITED" in printed) == is_marked, exercise
    run("06", MASKS, YOUR_MASKS["06_3"][0])
    printed = run("07", "01 02 03 04 06")["printed"]
    assert "masks: {'width': 3} (not the thesis's" in printed


def ranges(*edits):
    """Lowest and highest errors of each choice of notebook 7."""
    names = run("07", CHOICES, *edits)
    rows = pd.DataFrame(
        {"choice": text} | names["errors"](each.poses, names["drive"])
        for (text, _), each in names["many"].items()
    ).groupby("choice")
    return rows.min(), rows.max()


def test_exercises_07_1_and_07_3(build):
    long = (
        "drives[SEQUENCE or min(drives)].subset(FRAMES)",
        "earlier.Sequence(settings.kitti, '00')",
    )
    low, high = ranges(long)
    assert low.loc["500 keypoints", "RMSE (m)"] < high.loc["as above", "RMSE (m)"]  # they overlap
    wide = high / low
    assert (wide.loc["refined estimator"] < 1.01).all() and (wide.loc["as above"] > 1.05).all()


@pytest.mark.torture
def test_errors_of_the_lab_that_exercises_06_2_07_1_and_07_2_promise(choose):
    choose(PROFILE="lab")
    thesis, sky, _ = rows_of("06", MASKS, SKY)  # as if opened first
    assert sky["keypoints"] < 0.3 * thesis["keypoints"] and sky[ROTATION] > 3 * thesis[ROTATION]
    run("06", MASKS)
    low, high = ranges()
    assert low.loc["500 keypoints", "RMSE (m)"] < high.loc["as above", "RMSE (m)"]
    assert low.loc["500 keypoints", ROTATION] > high.loc["as above", ROTATION]
    thesis, small, _ = rows_of("07", LOOP, WINDOW_OF_5)
    assert small[ROTATION] > 1.2 * thesis[ROTATION]


@pytest.fixture
def streets():
    """Runs of the eight real streets in git, as notebook 8 has them."""
    folder = ROOT / "figures/kitti_excerpts"
    return [
        pd.read_csv(folder / name, dtype={"sequence": str}, low_memory=False)
        for name in ("runs.csv", "shuffled_runs.csv")
    ]


@pytest.mark.parametrize("metric", ["rotation", "rmse"])
def test_exercise_08_1(streets, metric):
    names = {"np": np, "pd": pd, "stats": stats, "comparisons": comparisons, "METRIC": metric}
    names = run("08", "38 39 51", runs=streets[0], **names)
    assert names["by_hand"] == pytest.approx(names["ratio"], rel=1e-9)
    inside = names["p_values"][1:3]
    assert min(inside) > 0.05 >= max(names["p_values"][0], names["p_values"][3])
    assert set(names["answers"].index) == {"se3", "rotation", "rmse"}


def test_exercises_08_2_and_08_3(streets):
    runs, shuffled = streets
    masked = runs.query("method == 'masked' and estimator == 'thesis'")
    by_width = run("08", "54", masked=masked)["by_width"]
    best = pd.DataFrame(run("08", "52", pd=pd, by_width=by_width)["widths_of"])
    assert (best["rmse"] != best["se3"]).any()
    widths = tuple(sorted(masked["dilation_width"].unique()))
    names = {"section_4_2": section_4_2, "shuffled": shuffled, "pd": pd}
    means = list(run("08", "53", WIDTHS=widths, **names)["means"].values())
    assert means == sorted(means, reverse=True) and means[0] > -1 and means[-1] < -10


def test_exercise_08_4(build):
    edits = ("FRAMES = settings.sizes.frames", "FRAMES = 12"), (ALL_SEQUENCES, '["00"]')
    rows = []
    for settings in ({"width": 10}, {"width": 10, "classes": ["sky"]}):
        (build / "masks.json").write_text(json.dumps(settings))
        names = run("08", "01 02 03 05 07 08", *edits)
        masked = [job for job in names["first"] if job.method == "masked"]
        rows.append(names["run"](masked))
    usual, sky = (each["mean_keypoints"].mean() for each in rows)
    assert sky < usual / 5
    usual, sky = (ratios.has_failed(each).sum() for each in rows)
    assert sky > usual


def test_exercise_09_1():
    changes = audit_of_tables.CHANGES["RMSE"]
    ratio_of = run("09", "11", np=np, stats=stats)["ratio_of"]
    ends = [re.findall(r"[\d.]+", ratio_of(each))[-2:] for each in (changes, changes[changes < 0])]
    (low, high), (_, below) = (map(float, each) for each in ends)
    assert low < 1 < high and below < 1


def test_exercise_09_2(build):
    frame = np.zeros((370, 1226), np.uint8)
    drive = tr.Sequence(read_settings().kitti, "00")
    names = {"cv2": cv2, "np": np, "tr": tr, "drive": drive, "frame": frame}
    names |= {"cityscapes": cityscapes, "earlier": earlier}
    usual, edited = (run("09", "25 28", CANNY=c, **names)["lost"] for c in ((5, 15), (1, 3)))
    assert edited < usual / 2


def test_exercise_09_3():
    kept = {}
    for side in (10, 5):
        names = {"cv2": cv2, "np": np, "plt": plt, "SQUARE": side}
        run("09", "31", keep=lambda *_, side=side: kept.update({side: _[2]}), **names)
    assert kept == {10: 0.5, 5: 0.0}
