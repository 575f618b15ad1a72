"""The gallery of a run, on a figures folder of made-up files."""

import re
from dataclasses import replace

import pandas as pd
import pytest
from cells import NOTEBOOKS, code_of

from keypoint_study.report import style
from thesis import audit, gallery
from thesis.run_settings import ROOT, read_settings

ARTEFACTS = [*gallery.OF_THESIS, *gallery.ADDED]
FIGURES = [artefact for artefact in ARTEFACTS if artefact["kind"] == "figure"]
TABLE = pd.DataFrame({"sequence": ["00", "01"], "RMSE (m)": [0.5, 12]})


@pytest.fixture
def run(tmp_path):
    """The settings of a run that has drawn every artefact."""
    folders = {name: str(tmp_path / name.lower()) for name in ("BUILD", "FIGURES")}
    settings = read_settings({f"THESIS_REPRO_{name}": path for name, path in folders.items()})
    settings.figures.mkdir(parents=True)
    (settings.build / "notebooks").mkdir()
    for artefact in ARTEFACTS:
        if artefact["kind"] == "table":
            style.save_table(TABLE, settings.figures, artefact["name"], "a note")
        else:
            ending = {"figure": ".svg", "text": ".md"}[artefact["kind"]]
            (settings.figures / f"{artefact['name']}{ending}").write_text("drawn")
    return settings


def test_it_has_every_artefact_in_the_order_of_the_thesis(run):
    gallery.update(run)
    text = (run.published / "README.md").read_text()
    titles = re.findall(r"^### (?:\w+ \w+\.\d+\. )?(.+)$", text, re.MULTILINE)
    assert titles == [artefact["title"] for artefact in ARTEFACTS] and len(gallery.THESIS) == 41
    links = re.findall(r"\]\(([^)]+)\)", text)
    assert len(links) > 30 and all((run.published / link).is_file() for link in links)
    assert (run.published / "figure_4_06.svg").read_text() == "drawn"
    assert str(run.published.parent) not in text


def test_missing_artefacts_are_listed_with_the_data_that_they_need(run):
    for name in ("figure_4_06.svg", "table_3_2.md", "figure_3_05.svg", "figure_3_01.svg"):
        (run.figures / name).unlink()
    real = replace(run, kitti_is_embedded=False)
    gallery.update(real)
    missing = re.findall(r"^Missing: (.*)\.$", (run.published / "README.md").read_text(), re.M)
    number = r"(Figure|Table) \w\.\d+"
    assert [re.match(number, line)[0] for line in missing] == [
        "Figure 3.1",
        "Figure 3.5",
        "Figure 4.6",
    ]
    assert ["CITYSCAPES=/path" in line for line in missing] == [True, True, False]
    # what shows no data comes from git
    table = (ROOT / "figures" / "table_3_2.md").read_text()
    assert (run.published / "table_3_2.md").read_text() == table


def test_each_artefact_is_saved_by_a_notebook_and_has_files_in_git():
    code = "".join(map(code_of, NOTEBOOKS))
    code += "".join(path.read_text() for path in (ROOT / "notebooks/thesis").glob("*.py"))
    named = set(re.findall(r'"(\w+)"', code))
    names = {artefact["name"] for artefact in ARTEFACTS if artefact["kind"] != "text"}
    assert names - named == set()
    assert {name for name in named if re.match(r"(figure|table)_\w_\d+$", name)} <= names
    assert [name for name in names if not list((ROOT / "figures").glob(f"{name}.*"))] == []


def test_the_gallery_in_git_is_made_from_what_is_in_git():
    """After a change of a caption or a table: `tools/write_texts.py`."""
    in_git = read_settings({})
    text = (ROOT / "figures" / "README.md").read_text()
    assert text == gallery.text(in_git)
    links = re.findall(r"\]\(([^)]+)\)", text)
    missing = [link for link in links if not (ROOT / "figures" / link).is_file()]
    assert len(links) > 60 and missing == []
    assert gallery.REAL_CHAPTER in text  # two runs: real and rendered
    assert (ROOT / "figures" / "audit.md").read_text() == gallery.page_of_audit(in_git)


def test_the_audits_page_in_git_has_each_rows_words_once_and_both_runs_numbers():
    cells = {"where": "A.8", "the thesis or its code": "x", "what would be right": "y"}
    first = dict.fromkeys(("metric", "estimator", "unit", "low", "high"), "") | cells
    first |= {"row": "2", "switch": "z", "quantity": "sum", "value": "-13.20", "data": "this run"}
    given = first | {"row": "10", "data": audit.ARITHMETIC}
    more = first | {"quantity": "mean", "value": "0.5", "low": "0.25", "high": "1e0"}
    unmeasured = first | {"quantity": "", "value": "", "data": ""}
    runs = {"a": [first, given], "b": [unmeasured | {"row": "1"}, unmeasured, more, given]}
    tables = {name: pd.DataFrame(lines) for name, lines in runs.items()}
    page = audit.side_by_side(tables)
    shown = ["row", "where", "quantity", audit.ARITHMETIC, "a", "b"]
    assert page[shown].to_numpy().tolist() == [
        ["1", "A.8", "", "", "", ""],
        ["2", "A.8", "sum", "", "-13.2", ""],
        ["2", "", "mean", "", "", "0.5 (0.25 to 1)"],
        ["10", "A.8", "sum", "-13.2", "", ""],
    ]


def test_numbers_of_the_run_stand_beside_the_thesiss(run):
    files = {
        "figure_4_01.csv": "epoch,val_loss\n1,0.8\n2,0.9\n",
        "table_4_1.csv": "sequence,mean keypoints\n00,500\n01,300\n",
        "timings/seconds.csv": (
            "sequence,method,dilation_width,threads,seconds\n"
            "00,baseline,,1,10\n00,masked,1,1,8\n00,masked,2,1,11\n"
        ),
    }
    for name, text in files.items():
        path = run.figures / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
    numbers = gallery.beside_the_thesis(run.figures)
    assert (numbers["figure_4_01"]["epochs"], numbers["figure_4_01"]["best"]["epoch"]) == (2, 1)
    assert list(numbers["figure_4_07"]["keypoints"]) == [500, 300]
    assert list(numbers["figure_4_17"]["saved"]) == [20, -10]
