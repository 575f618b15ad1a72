"""Which notebooks are executed again: contents decide, not times."""

import json
import os
import time

import pytest
from cells import NOTEBOOKS, named
from trials import PACKAGES, copy_project, finish, start

from thesis import run
from thesis.run_settings import ROOT, read_settings
from thesis_repro.running import provenance

OUTPUT = '"outputs": [{"output_type": "stream", "name": "stdout", "text": ["shown"]}]'
ALL = "01 02 03 04 05 06 07 08 09"
HOUR = 3600


@pytest.fixture(scope="module")
def project(tmp_path_factory):
    root = tmp_path_factory.mktemp("project")
    copy_project([*PACKAGES, "notebooks"], root)
    return root


@pytest.fixture
def settings(project, tmp_path, monkeypatch):
    """Of a run of the copy, in which every notebook was executed."""
    for module in (run, provenance):
        monkeypatch.setattr(module, "ROOT", project)
    settings = read_settings({"THESIS_REPRO_BUILD": str(tmp_path / "build")})
    (settings.build / "notebooks").mkdir(parents=True)
    (settings.build / "checked").touch()
    assert again(settings) == ALL.split()
    make(settings)
    return settings


def again(settings):
    """The numbers of the notebooks that are missing once what is out of date is deleted."""
    provenance.digest_of_code.cache_clear()
    run.drop_old(settings, run.wanted(settings))
    return [name[:2] for name in NOTEBOOKS if not (settings.build / "notebooks" / name).exists()]


def make(settings):
    """Stand in for make: write what is missing."""
    (settings.build / "sequences").touch()
    for name in NOTEBOOKS:
        executed = settings.build / "notebooks" / name
        if not executed.exists():
            text = (run.ROOT / "notebooks" / name).read_text()
            executed.write_text(text.replace('"outputs": []', OUTPUT))


@pytest.mark.parametrize(
    "path, old, new, numbers",
    [
        ("notebooks/06_keypoint_masks.ipynb", "import", " import", "06 07 08 09"),
        ("thesis_repro/masks/filter.py", "cv2.Canny(", "cv2.Canny(*", ALL),
        ("street_world/raster.py", "- 0.5", "- 0.25", ALL),
        ("notebooks/thesis/audit.json", "{", " {", "09"),
        ("notebooks/06_keypoint_masks-Copy1.ipynb", "", "{}", ""),
        ("notebooks/01_load_images_and_labels.ipynb", "## Classes", "## All classes", ""),
    ],
)
def test_what_uses_other_contents_is_executed_again(project, settings, path, old, new, numbers):
    """The file keeps its date, as after rsync -a, tar or cp -p."""
    file = project / path
    before = file.read_text() if file.exists() else ""
    assert old in before
    file.write_text(before.replace(old, new, 1))
    os.utime(file, (0, 0))
    try:
        assert again(settings) == numbers.split()
        assert again(settings) == numbers.split()  # stopped before make began
        make(settings)
        assert again(settings) == []
    finally:
        file.write_text(before)
    # an edited sentence is put into what a notebook made
    executed = (settings.build / "notebooks" / NOTEBOOKS[0]).read_text()
    assert ("## All data" in executed) == ("## All data" in new)
    assert executed.count('"shown"') > 5


def test_a_damaged_notebook_is_left_to_nbconvert(project, settings):
    notebook = project / "notebooks" / named("07")
    before = notebook.read_text()
    notebook.write_text(before[:-9])
    assert again(settings) == ["07"]
    notebook.write_text(before)


def test_what_an_edited_lesson_has_drawn_is_made_again(project, settings, caplog):
    """It was run by hand, in the folder of the run: figure 3.1 is notebook 02's, masks 06's."""
    caplog.set_level("INFO")
    figures = settings.figures
    figures.mkdir()
    for name in ("figure_3_01.webp", "masks.csv", "figure_4_17.svg"):
        (figures / name).write_text("by make figures")
    assert again(settings) == []  # nothing is known of what was left
    for name, numbers in (
        ("figure_4_17.svg", "08 09"),
        ("masks.csv", "06 07 08 09"),
        ("figure_3_01.webp", "02 04 05 06 07 08 09"),
        ("own.svg", ""),
    ):
        (settings.build / "drawn").write_text(json.dumps(run._drawn(settings)))
        assert again(settings) == []
        (figures / name).write_text("by an edited lesson")
        caplog.clear()
        assert again(settings) == again(settings) == numbers.split()
        assert bool(numbers) == any(f"because {name} " in line for line in caplog.messages)
        make(settings)
    (settings.build / "drawn").write_text(json.dumps(run._drawn(settings)))
    (figures / "figure_3_01.webp").rename(
        figures / "figure_3_01.svg"
    )  # of an edit that draws lines
    assert again(settings)[0] == "02"


@pytest.mark.parametrize("ahead", [-2 * HOUR, 2 * HOUR])
def test_a_clock_that_was_wrong_changes_nothing(settings, ahead):
    for number, path in enumerate(sorted(settings.build.rglob("*"))):
        date = time.time() + ahead + number % 7
        os.utime(path, (date, date))
    assert again(settings) == []


def test_what_needs_a_missing_notebook_is_executed_again(settings):
    (settings.build / "notebooks" / named("06")).unlink()
    assert again(settings) == ["06", "07", "08", "09"]
    make(settings)
    (settings.build / "sequences").unlink()  # 05 takes them
    assert again(settings) == ["05", "06", "07", "08", "09"]
    make(settings)
    (settings.build / "checked").write_text("other data")
    assert again(settings) == ALL.split()


def test_real_frames_alone_need_no_training(tmp_path):
    settings = read_settings({"THESIS_REPRO_KITTI": str(tmp_path)})
    assert " ".join(name[:2] for name in run.wanted(settings)) == "03 05 06 07 08 09"
    rules = run.rules(run.wanted(settings))
    assert "04_training" not in rules and "sequences" not in rules


# In place of python, nbconvert and tools/render_ahead.py: 02 fails.
PYTHON = """#!/bin/bash
name=sequences
for word; do case $word in notebooks/0*) name=${word#notebooks/};; esac; done
echo $name >>order
case $name in 02*) test -e works || exit 1;; sequences) exit 0;; esac
: >run/notebooks/.$name
"""


def test_make_executes_what_is_missing_in_order(tmp_path):
    """02 has failed, at first; dates of what exists do not count."""
    (tmp_path / "bin").mkdir()
    (tmp_path / "bin/python").write_text(PYTHON)
    (tmp_path / "bin/python").chmod(0o755)
    (tmp_path / "run/notebooks").mkdir(parents=True)
    (tmp_path / "run/needs.mk").write_text(run.rules(list(run.NEEDS)))
    executed = []
    for status in (2, 0, 0):
        (tmp_path / "order").write_text("")
        words = ["make", "-k", "-j2", "-f", ROOT / "Makefile", "notebooks", "RUN=run", "BIN=bin"]
        result = finish(start(words, tmp_path, MAKEFLAGS=None, MFLAGS=None))
        assert result.returncode == status, result
        lines = (tmp_path / "order").read_text().split()
        executed.append([line.partition("_")[0] for line in lines])
        (tmp_path / "works").touch()
        os.utime(tmp_path / "run/notebooks" / NOTEBOOKS[0])  # the first one becomes the newest
    assert sorted(executed[0]) == ["01", "02", "03", "sequences"]
    assert sorted(executed[1]) == ["02", "04", "05", "06", "07", "08", "09"]
    places = {name: place for place, name in enumerate(executed[1])}
    for name, needed in run.NEEDS.items():
        for other in needed:  # what was executed before is there
            assert places.get(other[:2], -1) < places.get(name[:2], 99), (name, other)
    assert executed[2] == []
