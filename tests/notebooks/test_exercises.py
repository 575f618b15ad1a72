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
import numba
import numpy as np
import pandas as pd
import pytest
from cells import NOTEBOOKS, cells, named
from scipy import stats
from small_network import small_network

import thesis_repro as tr
from keypoint_study import comparisons
from thesis import artefacts, audit, real_frames, tables
from thesis.run_settings import PREFIX, ROOT, read_settings
from thesis_repro import masks
from thesis_repro.data import cityscapes
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.running import provenance

# the cells that an edit goes through, without those that only show something
READING = "01 28 03 09 30 31 11 32 13 15"
TRANSFORMS = "01 20 03 04 15 22 23"
DOUBLED = f"{TRANSFORMS} 08 24 29 17"
NETWORK = "01 32 03 15 39 19 34"
UNTRAINED = "01 27 03 08 05 06 45 14 60"
TRAINING = f"{UNTRAINED} 32 18 40 41"
LESS_PATIENCE = "PATIENCE = sizes.patience", "PATIENCE = 1"
FOCAL = "total_loss = dice_loss_plus_1focal_loss", "total_loss = focal_loss"
FIRST = "01 03 06"  # of notebook 6
MASKS = f"{FIRST} 12 46 47 48"
PREDICTION = "01 02 04 15 23"
LOOP = "01 03 06 47 52 15 18 24 39 40 80"
TRACKS = "01 03 06 15 16 18 19"
CHOICES = "01 03 06 52 54"
TEXT = "aligned ATE (m)"
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


# exercise: (cells, an old and a new text, what is looked at, what holds of it before and after)
BEFORE_AND_AFTER = {
    "01_1": (
        READING,
        ("LABEL_RESIZING = cv2.INTER_NEAREST", "LABEL_RESIZING = cv2.INTER_LINEAR"),
        lambda names: set(np.unique(names["labels"])),
        operator.lt,
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
}
# exercise: (an old and a new text, what masks.json holds beside the width of 10, what holds of the
# row "yours" of the table of notebook 6 as a ratio to the row "masks")
YOUR_MASKS = {
    "06_1": (
        ("CANNY = 10, (5, 15)", "CANNY = 10, (1, 3)"),
        {"canny": [1, 3]},
        lambda row: row["coverage (%)"] > 1.05 and row["keypoints"] > 1,
    ),
    "06_2": (
        ("CANNY = 10, (5, 15)", "CANNY = 3, (5, 15)"),
        {"width": 3},
        lambda row: row["coverage (%)"] < row["keypoints"] < 1,
    ),
    "06_2, turned round": (
        ("return edges, cv2.dilate", "return edges, 255 - cv2.dilate"),
        {},
        lambda row: row["keypoints"] > 1,
    ),
}
# the same of notebook 7, and whether its cell prints EDITED
YOUR_LOOP = {
    "07_2": (
        ('"maxLevel": 3', '"maxLevel": 0'),
        True,
        lambda row: row[ROTATION] > 5,
    ),
    "07_2, the position": (
        ("+ scale * (pose", "+ 2 * scale * (pose"),
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
def lessons(executed, build):
    """The same, with what the executed notebooks 1 to 3 left."""
    left = executed / "build/embedded-smoke"
    shutil.copytree(left / "data", build / "data")
    shutil.copy(left / "network.keras", build)
    return build


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
@pytest.mark.notebooks
def test_an_edit_has_the_promised_effect(exercise, lessons):
    ids, edit, look, holds = BEFORE_AND_AFTER[exercise]
    usual, edited = (look(run(exercise[:2], ids, *edits)) for edits in ((), [edit]))
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


@pytest.mark.notebooks
def test_exercise_02_2(lessons):
    written = []
    full = "FULL_VALIDATION_AUGMENTATION = False", "FULL_VALIDATION_AUGMENTATION = True"
    for edit in ((), [full]):
        run("02", DOUBLED, *edit)
        files = sorted((lessons / "data").glob("doubled_*"))
        written.append({file.stem: file.read_bytes() for file in files})
    same = {name for name in written[0] if written[0][name] == written[1][name]}
    assert same == {"doubled_train_images", "doubled_train_labels"}


@pytest.mark.notebooks
def test_an_edited_training_stands_beside_the_runs_and_leaves_it_alone(executed, lessons):
    left = executed / "build/embedded-smoke/model"
    shutil.copytree(left, lessons / "model")
    usual = run("04", TRAINING)  # it is trained already
    assert usual["folder"] == lessons / "model" and list(usual["scores"]) == ["model"]
    history = pd.read_csv(left / "history.csv")
    assert usual["resumable"].history.equals(history) and usual["history1"].history == {}
    small_network(64).save(lessons / "network.keras")  # a U-Net takes seconds to compile
    edited = run("04", TRAINING, FOCAL)
    assert edited["folder"] == lessons / "model_edited" and "EDITED" in edited["printed"]
    assert list(edited["scores"]) == ["model", "model_edited"]
    assert edited["scores"]["model"] == usual["scores"]["model"]
    assert run("04", UNTRAINED, LESS_PATIENCE)["folder"] == lessons / "model_edited"
    for path in left.iterdir():
        if path.name != "model.keras":  # saved again, with another date
            assert (lessons / "model" / path.name).read_bytes() == path.read_bytes(), path


@pytest.mark.torture
def test_exercises_04_1_and_04_2(choose):
    """What the lab promises of less patience, and of another loss."""
    choose(PROFILE="lab")
    run("01", READING.replace("03", "03 05") + " 25")
    run("02", DOUBLED)
    run("03", f"{NETWORK} 27")
    usual, hasty, focal = (run("04", TRAINING, *edits) for edits in ((), [LESS_PATIENCE], [FOCAL]))
    all_losses, losses = (names["resumable"].history["val_loss"] for names in (usual, hasty))
    # threads are not fixed here, so the last digits differ from those of the lab
    assert (len(losses), losses.idxmin()) == (4, 2) and all_losses.idxmin() > 3
    assert hasty["scores"]["model_edited"]["mean IoU"] < 0.8 * usual["scores"]["model"]["mean IoU"]
    found = [focal["scores"][name]["classes found"] for name in ("model", "model_edited")]
    assert found[1] < 0.8 * found[0]


def test_exercise_05_1(build):
    _, labels = cityscapes.load(cityscapes.pairs(read_settings().cityscapes, "val"), 64)
    moved = []
    for name in ("building", "traffic sign", "pole"):
        label = cityscapes.LABELS[cityscapes.ID[name]]
        names = {"np": np, "test_labels": labels, "label": label, "CLASS": name}
        printed = run("05", "56", **names)["printed"]
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
    artefacts.label_maps()
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
    thesis, yours = (rows[1:] if number == "06" else pd.DataFrame(rows).T).iloc
    return thesis, yours, names["printed"]


def test_your_masks_stand_beside_the_thesiss(build):
    thesis, yours, _ = rows_of("06", MASKS)
    assert thesis.equals(yours) and thesis["keypoints"] > 100
    assert json.loads((build / "masks.json").read_text()) == {"width": 10}
    for exercise, (edit, settings, holds) in YOUR_MASKS.items():
        first, yours, _ = rows_of("06", MASKS, edit)
        assert first.equals(thesis) and holds(yours / thesis), exercise
        written = json.loads((build / "masks.json").read_text())
        assert written == {"width": 10} | settings, exercise


def test_the_table_of_lesson_6_has_the_run_without_masks(build):
    names = run("06", MASKS)
    every, part = names["rows"].loc["all keypoints"], names["part"]
    result = tr.run(part)
    assert every["coverage (%)"] == 100
    assert every["aligned ATE (m)"] == metrics.ate(result.poses, part.poses, "se3")
    assert every["keypoints"] == result.frames["detected"].mean()


def test_notebooks_6_and_7_can_be_opened_first_and_make_label_maps_to_the_end(build):
    (build / "labels").unlink()
    printed = run("07", "01 03 06")["printed"]
    assert "masks: {'width': 10}" in printed and "not the thesis's" not in printed
    maps = sorted((build / "labels").glob("*/*.png"))
    before = [path.read_bytes() for path in maps]
    assert artefacts.data_note().endswith("label maps: by the model in the package")
    for path in maps[3:]:  # as if the notebook was stopped
        path.unlink()
    run("06", FIRST)
    assert [path.read_bytes() for path in maps] == before and len(before) == 10
    made = [path.stat().st_ino for path in maps]
    assert label_maps_by()[0] == "the model in the package"  # notebook 4 was not run
    # the same label maps stay for whoever has opened them
    assert [path.stat().st_ino for path in maps] == made


@pytest.mark.parametrize("by_make", [False, True])
def test_a_lesson_that_compiles_says_so_once(by_make, capsys, monkeypatch):
    """Not in one that `make figures` executes, whose outputs are published."""
    monkeypatch.setattr(numba.core.event, "_registered", defaultdict(list))  # begun before or not
    artefacts.say_that_it_compiles.cache_clear()
    if by_make:
        monkeypatch.setenv(f"{PREFIX}PROGRESS", "/dev/null")
    artefacts.say_that_it_compiles()
    for number in (1, 2):
        numba.njit(lambda x, number=number: x + number)(number)
    assert capsys.readouterr().out.count("compiling") == int(not by_make)


def test_a_damaged_picture_is_named(build, tmp_path, small_world, choose):
    shutil.copytree(small_world / "cityscapes", tmp_path / "images")
    shutil.copytree(small_world / "kitti", tmp_path / "frames")
    choose(CITYSCAPES=tmp_path / "images", KITTI=tmp_path / "frames", PROFILE="smoke", FRAMES=5)
    pair = cityscapes.pairs(tmp_path / "images", "train")[1]
    frame = artefacts.sequences()[-1].frame_paths[2]
    for path, number, cells_read in (
        (pair.image, "01", READING),
        (pair.label, "01", READING),
        (frame, "05", PREDICTION.replace("23", "17")),
    ):
        whole = path.read_bytes()
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(AssertionError, match=f"{path.name}: damaged"):
            run(number, cells_read)
        path.write_bytes(whole)


def test_notebook_9_says_whose_runs_it_reads(build):
    assert "real streets" in run("09", "14", artefacts=artefacts, tables=tables, pd=pd)["printed"]
    for name in ("runs.csv", "shuffled_runs.csv"):
        shutil.copy(real_frames.FOLDER / name, build)
    assert artefacts.results()[2] == "this run"


def test_lessons_2_and_4_name_the_notebook_that_they_need(build):
    with pytest.raises(InputError, match="data.*01_load_images_and_labels"):
        run("02", "01 20 03 04")
    with pytest.raises(InputError, match="data.*02_augmentation"):
        run("04", "01 27 03 05")


def label_maps_by(*edits):
    """The model with which notebook 5 makes label maps, and what figures say about them."""
    names = run("05", PREDICTION, *edits)
    assert artefacts.used_model().input_shape == names["model"].input_shape
    assert artefacts.data_note() == names["note"]
    return names["whose"], names["model"].input_shape[1], names["note"]


@pytest.mark.notebooks
def test_label_maps_are_of_the_model_that_notebook_5_names_in_any_order(lessons, small_model):
    (lessons / "labels").unlink()
    (lessons / "model").mkdir()
    shutil.copy(small_model, lessons / "model")
    own = "the model of this run", 64, read_settings().data_note
    package = "the model in the package", 320, f"{own[2]}; label maps: by the model in the package"
    shipped = "SHIPPED = not artefacts.is_trained()", "SHIPPED = True"
    ways = [label_maps_by(), label_maps_by(shipped), label_maps_by()]
    assert ways == [own, package, own]
    run("06", FIRST)  # leaves the label maps of notebook 5
    assert artefacts.data_note() == own[2]


@pytest.mark.notebooks
def test_label_maps_of_an_earlier_training_or_of_two_networks_are_named(lessons, small_model):
    folder = lessons / "model"
    folder.mkdir()
    shutil.copy(small_model, folder)
    (lessons / "labels").unlink()
    label_maps_by()
    again = artefacts.model_of_run()
    again.set_weights([weights + 0.1 for weights in again.get_weights()])
    again.save(folder / "model.keras")
    with pytest.raises(InputError, match="labels.*05_prediction"):
        artefacts.used_model()
    shutil.rmtree(lessons / "labels/00")  # as if notebook 5 was stopped after its first sequence
    provenance.stage(lessons / "labels/00", model="another")
    for opened in (lambda: run("06", FIRST), artefacts.used_model, artefacts.data_note):
        with pytest.raises(InputError, match="labels.*two networks.*05_prediction"):
            opened()
    assert [label_maps_by()[0] for _ in range(2)] == ["the model of this run"] * 2


def test_your_loop_stands_beside_the_thesiss(build):
    run("06", MASKS)
    names = run("07", LOOP)
    (thesis, yours), printed = pd.DataFrame(names["rows"]).T.iloc, names["printed"]
    by_hand = names["path_by_hand"](names["sequence"], names["label_masks"])
    assert np.array_equal(by_hand, names["masked"].poses)
    assert thesis.round(9).equals(yours.round(9)) and thesis["RMSE (m)"] > 0
    assert "masks: {'width': 10}" in printed and "not the thesis's" not in printed
    assert "EDITED" not in printed
    for exercise, (edit, is_marked, holds) in YOUR_LOOP.items():
        first, yours, printed = rows_of("07", LOOP, edit)
        assert first.equals(thesis) and holds(yours / thesis), exercise
        assert ("EDITED" in printed) == is_marked, exercise
    tracked = [len(run("07", TRACKS, *edits)["new"]) for edits in ((), [YOUR_LOOP["07_2"][0]])]
    assert tracked[1] > tracked[0] > 1000
    run("06", MASKS, YOUR_MASKS["06_2"][0])
    printed = run("07", "01 03 06")["printed"]
    assert "masks: {'width': 3} (not the thesis's" in printed


def ranges(*edits):
    """Lowest and highest errors of each choice of notebook 7."""
    names = run("07", CHOICES, *edits)
    rows = pd.DataFrame(
        {"choice": text} | names["errors"](each.poses, names["sequence"])
        for (text, _), each in names["many"].items()
    ).groupby("choice")
    return rows.min(), rows.max()


def test_exercise_07_1(build):
    long = (
        "sequences[SEQUENCE or min(sequences)].subset(FRAMES)",
        "artefacts.Sequence(settings.kitti, '00')",
    )
    low, high = ranges(long)
    assert (
        low.loc["500 keypoints", "RMSE (m)"] < high.loc["all keypoints", "RMSE (m)"]
    )  # they overlap
    wide = high / low
    assert (wide.loc["all, refined estimator"] < 1.01).all()
    assert (wide.loc["all keypoints"] > 1.05).all()


@pytest.mark.torture
def test_errors_of_the_lab_that_exercise_07_1_promises(choose):
    choose(PROFILE="lab")
    low, high = ranges()
    assert low.loc["500 keypoints", "RMSE (m)"] < high.loc["all keypoints", "RMSE (m)"]
    assert low.loc["500 keypoints", ROTATION] > high.loc["all keypoints", ROTATION]


@pytest.fixture
def streets():
    """Runs of the eight real streets in git, as notebook 8 has them."""
    folder = ROOT / "figures/kitti_excerpts"
    return [
        pd.read_csv(folder / name, dtype={"sequence": str}, low_memory=False)
        for name in ("runs.csv", "shuffled_runs.csv")
    ]


def test_exercise_08_1(streets):
    names = {"runs": streets[0], "tables": tables, "pd": pd}
    names = run("08", "58", **names)
    by_hand = {
        metric: run("08", "31", **(names | {"METRIC": metric}))["by_hand"]
        for metric in ("rmse", "mae", "se3")
    }
    for metric in ("rmse", "mae"):
        parts = names["masked"], names["baseline"], streets[1]
        table = tables.table_of_change(*parts, metric, "thesis").set_index("sequence")
        package = table.loc[by_hand[metric].index, "change (%)"]
        assert by_hand[metric].to_numpy() == pytest.approx(package.to_numpy(), abs=0.006)
    assert by_hand["se3"].median() > by_hand["rmse"].median()


def test_exercise_08_2(streets):
    runs, shuffled = streets
    masked, baseline = (
        comparisons.of_method(runs, name, "thesis") for name in ("masked", "baseline")
    )
    widths = tuple(sorted(masked["dilation_width"].unique()))
    names = {"tables": tables, "shuffled": shuffled, "pd": pd}
    names |= {"masked": masked, "baseline": baseline, "WIDTHS": widths}
    studies = run("08", "53", **names)["studies"]
    means = [values[0] for name, values in studies.items() if name.startswith("nothing")]
    assert means == sorted(means, reverse=True) and means[0] > -1 and means[-1] < -10


def test_exercise_09_1():
    changes = audit.CHANGES["RMSE"]
    ratio_of = run("09", "11", np=np, stats=stats, changes=audit.CHANGES)["ratio_of"]
    ends = [re.findall(r"[\d.]+", ratio_of(each))[-2:] for each in (changes, changes[changes < 0])]
    (low, high), (_, below) = (map(float, each) for each in ends)
    assert low < 1 < high and below < 1


def test_exercise_09_2(build):
    frame = np.zeros((370, 1226), np.uint8)
    sequence = tr.Sequence(read_settings().kitti, "00")
    names = {"cv2": cv2, "np": np, "tr": tr, "sequence": sequence, "frame": frame}
    names |= {"cityscapes": cityscapes, "artefacts": artefacts}
    usual, edited = (run("09", "25 28", CANNY=c, **names)["lost"] for c in ((5, 15), (1, 3)))
    assert edited < usual / 2
