"""README and the answer are those of their templates, short, and follow the tables."""

import re
import warnings

import cv2
import numpy as np
import pytest

import thesis_repro as tr
import write_texts
from keypoint_study import comparisons, verdicts
from keypoint_study.report import style
from thesis import claim_rule, claims, equal_number
from thesis_repro.odometry import metrics


@pytest.mark.parametrize(
    "template, words",
    [
        ("README.md.j2", 700),
        ("answer.md.j2", 650),
        ("reading-results.md.j2", 1200),
        ("options.md.j2", 1200),
    ],
)
def test_texts_in_git_are_those_of_the_tables_and_short(template, words):
    written = write_texts.WRITTEN[template].read_text(encoding="utf-8")
    assert written.splitlines() == write_texts.render(template).splitlines()
    number = len(
        written.partition("\n")[2].split()
    )  # the first line says what the text is made from
    if number > words:
        warnings.warn(f"{template}: {number} words, over {words}", stacklevel=1)


def test_tables_made_from_tables_in_git_are_those_in_git():
    folder = write_texts.ROOT / "figures" / write_texts.REAL
    note, found = write_texts.data_note(), write_texts.all_claims()
    text = (folder / "claims.md").read_text(encoding="utf-8")
    assert text == claims.text_of_claims(found, note)
    assert {claim.word for claim in found} == set(claim_rule.WORDS)
    pairs = equal_number.table_of_pairs(
        write_texts.read_table(f"{write_texts.REAL}few_keypoints_runs"),
        write_texts.read_table(f"{write_texts.REAL}runs"),
    )
    table = (folder / "equal_number.md").read_text(encoding="utf-8")
    assert table.startswith(style.markdown(pairs)) and note in table


@pytest.fixture
def with_masks(monkeypatch):
    """A function that multiplies the errors with masks, on the given streets or on all."""
    read = write_texts.read_table
    unread = comparisons.METRIC_TITLES.keys() - {"rmse", "mae", "se3", "rotation"}

    def change(factor, streets=slice(None)):
        monkeypatch.setattr(claim_rule, "STUDIES", 20)  # test_claims.py asserts what they show
        runs = read(f"{write_texts.REAL}runs").drop(columns=unread)
        runs = runs[runs["sequence"].isin(sorted(runs["sequence"].unique())[streets])].copy()
        masked = runs["method"] == "masked"
        runs.loc[masked, ["se3", "rotation"]] *= factor
        monkeypatch.setattr(
            write_texts, "read_table", lambda name: runs if name.endswith("/runs") else read(name)
        )
        forget()

    def forget():
        for function in (write_texts.compared, write_texts.at_hand, write_texts.all_claims):
            function.cache_clear()

    yield change
    forget()


@pytest.mark.parametrize(
    "factor, streets, outcome",
    [
        (1e-3, slice(None), verdicts.LOWER),
        pytest.param(1e3, slice(None), verdicts.HIGHER, marks=pytest.mark.torture),
        (1, slice(4), verdicts.TOO_FEW),
    ],
)
def test_texts_say_every_outcome_of_the_runs(with_masks, factor, streets, outcome):
    with_masks(factor, streets)
    assert write_texts.equal(*equal_number.PAIRS[-1])["verdict"] == outcome
    readme, answer = map(write_texts.render, ("README.md.j2", "answer.md.j2"))
    said = f"rrors with masks are {write_texts.VERDICT_PHRASES[outcome]} those with all keypoints"
    assert said in readme and said in answer


LINK = re.compile(r"\[([^]]*)\]\(([^)]*)\)")
# what is no result: names, and what was chosen
NAMED = re.compile(
    r"[Ww]idth 10|of 15 widths|\b(200|800) (strongest|spread|random)|16 filters in place of 64|"
    r"13\.2 %|80 % of studies|95 %"
)


def numbers_of(text):
    """The numbers of a text; "0.87-2.91" has two."""
    return re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", re.sub(r"(?<=\d)-(?=\d)", " ", text))


@pytest.mark.parametrize("name", ["answer.md.j2", "README.md.j2"])
def test_each_number_stands_in_the_table_that_its_sentence_links(name):
    path, found = write_texts.WRITTEN[name], 0
    text = re.sub(r"(?s)```.*?```|<!--.*?-->|!\[.*?\]\(.*?\)", "", path.read_text(encoding="utf-8"))
    if name.startswith("README"):  # its results; the rest is no result
        text = text[: text.index("## Two commands")]
    for block in text.split("\n\n"):
        links = [path.parent / target for _, target in LINK.findall(block)]
        tables = [link for link in links if link.suffix == ".md" and "figures" in link.parts]
        if block.startswith("|"):  # all of its columns name their tables
            pieces = [(block, tables)]
        else:
            pieces = [*zip(re.split(LINK, block)[::3], [[link] for link in links] + [[]])]
        for piece, of_piece in pieces:
            numbers = numbers_of(NAMED.sub("", LINK.sub(r"\1", piece)))
            known = " ".join(
                each.read_text("utf-8") for each in of_piece if "figures" in each.parts
            )
            for number in numbers:
                assert number in numbers_of(known) or number == "11", (number, piece)
                found += 1
    assert found >= (60 if name.startswith("answer") else 9)


@pytest.mark.real
def test_a_mounting_angle_changes_the_rotation_by_a_hundredth_of_a_degree_at_most(kitti_real):
    angle = cv2.Rodrigues(np.radians([0.3, 0, 0]))[0]
    added = {}
    streets = write_texts.read_table(f"{write_texts.REAL}streets")
    for name, frames in streets[["sequence", "frames"]].itertuples(index=False):
        if not name.startswith("drive"):
            poses = tr.Sequence(kitti_real, name).subset(int(frames)).poses
            turned = poses.copy()
            turned[:, :3, :3] = angle.T @ poses[:, :3, :3] @ angle
            added[name] = metrics.step_errors(turned, poses)["rotation"]
    assert max(added, key=added.get) == "01" and 0.005 < added["01"] < 0.0105
