"""An edit of a cell shows in the last table of its notebook, beside the thesis's.

The cells concerned run in this process, on the small world.
"""

import json

import pytest
from cells import cells, named

from thesis.settings import PREFIX, read_settings
from thesis_repro.errors import InputError

# the cells that an edit goes through, without those that only show something
MASKS = ["01", "02", "03", "05", "06", "52", "12", "13", "45", "46", "54", "48"]
LOOP = ["01", "02", "03", "04", "06", "15", "18", "23", "24", "39", "40", "43", "44", "52"]
TABLE = {"06": "47", "07": "60"}
TEXT = "aligned ATE (m)"


@pytest.fixture
def build(small_world, small_labels, tmp_path, monkeypatch):
    """The folder of a run on the small world, with the label maps of notebook 5."""
    values = {
        "PROFILE": "smoke",
        "FRAMES": 5,
        "KITTI": small_world / "kitti",
        "CITYSCAPES": small_world / "cityscapes",
        "BUILD": tmp_path,
    }
    for name, value in values.items():
        monkeypatch.setenv(PREFIX + name, str(value))
    folder = read_settings().build
    folder.mkdir(parents=True)
    (folder / "labels").symlink_to(small_labels)
    return folder


def run(number, ids, edits=()):
    """The names that cells of a notebook leave; edits: pairs of an old and a new text."""
    by_id = cells(named(number), "code")
    text = "\n\n".join(by_id[f"{number}-{each}"] for each in ids)
    for old, new in edits:
        assert text.count(old) == 1, old
        text = text.replace(old, new)
    names = {}
    exec(text, names)
    return names


def table(number, ids, *edits):
    """The last table of a notebook: the thesis's row, and the reader's."""
    names = run(number, ids, edits)
    *before, last = cells(named(number), "code")[f"{number}-{TABLE[number]}"].splitlines()
    exec("\n".join([*before, f"shown = {last}"]), names)
    thesis, yours = names["shown"].iloc
    return thesis, yours


def test_an_edit_of_the_masks_shows_in_the_last_table_of_its_notebook(build, capsys):
    thesis, yours = table("06", MASKS)
    assert thesis.equals(yours) and thesis["keypoints"] > 100
    assert json.loads((build / "masks.json").read_text()) == {"width": 10}
    assert "to the bit: True" in capsys.readouterr().out
    wide, narrow = ("CANNY = (5, 15)", "CANNY = (1, 3)"), ("WIDTH = 10 ", "WIDTH = 3 ")
    sky = "classes=(),", 'classes=("sky",),'
    twice = "dilate(edge_image, kernel)", "dilate(edge_image, kernel, None, None, 2)"
    keypoints = {}
    for edit in (wide, narrow, sky, twice):
        first, second = table("06", MASKS, edit)
        assert first.equals(thesis)
        keypoints[edit] = second["keypoints"]
        assert ("EDITED" in capsys.readouterr().out) == (edit == twice)
        settings = json.loads((build / "masks.json").read_text())
        assert settings == {"width": 3 if edit == narrow else 10} | {
            wide: {"canny": [1, 3]},
            sky: {"classes": ["sky"]},
        }.get(edit, {})
    assert keypoints[sky] < keypoints[narrow] < thesis["keypoints"]
    assert thesis["keypoints"] < min(keypoints[wide], keypoints[twice])


def test_an_edit_of_the_loop_shows_in_the_last_table_of_its_notebook(build, capsys):
    with pytest.raises(InputError, match="run notebook 06_keypoint_masks first"):
        run("07", LOOP)
    run("06", MASKS)
    thesis, yours = table("07", LOOP)
    assert thesis.equals(yours) and thesis["keypoints"] > 1000
    out = capsys.readouterr().out
    assert "EDITED" not in out and "masks: {'width': 10}" in out and "not the thesis's" not in out
    few = table("07", LOOP, ("MAX_KEYPOINTS = 2000", "MAX_KEYPOINTS = 500"))
    assert few[0].equals(thesis) and few[1]["keypoints"] <= 500 and few[1][TEXT] != thesis[TEXT]
    assert "EDITED" not in capsys.readouterr().out  # the package does the same with this knob
    double = "position + scales[number]", "position + 2 * scales[number]"
    edited = table("07", LOOP, double)
    assert edited[0].equals(thesis) and edited[1][TEXT] > 10 * thesis[TEXT]
    assert "EDITED" in capsys.readouterr().out
    run("06", MASKS, [("WIDTH = 10 ", "WIDTH = 3 ")])
    run("07", LOOP[:5])
    assert "masks: {'width': 3} (not the thesis's" in capsys.readouterr().out


def test_answers_run_when_somebody_asks_for_them(build):
    cells_of_answers = [*MASKS[:5], "50", "51"]
    waiting = run("06", cells_of_answers)
    assert waiting["runs"] == {} and not waiting["RUN_ANSWERS"]
    ids = [*MASKS[:5], "45", "46", "50", "51"]
    assert len(run("06", ids, [("RUN_ANSWERS = False", "RUN_ANSWERS = True")])["rows"]) == 5
