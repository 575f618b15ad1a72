"""README and the answer are those of their templates, short, and follow the tables."""

import warnings

import cv2
import numpy as np
import pytest

import thesis_repro as tr
import write_texts
from keypoint_study import comparisons, verdicts
from keypoint_study.report import style
from thesis import claims, equal_number
from thesis_repro.odometry import metrics


@pytest.mark.parametrize(
    "template, words",
    [
        ("README.md.j2", 900),
        ("answer.md.j2", 1200),
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


@pytest.fixture
def with_masks(monkeypatch):
    """A function that multiplies the errors with masks, on the given streets or on all."""
    read = write_texts.read_table
    unread = comparisons.METRIC_TITLES.keys() - {"rmse", "mae", "se3", "rotation"}

    def change(factor, streets=slice(None)):
        runs = read(f"{write_texts.REAL}runs").drop(columns=unread)
        runs = runs[runs["sequence"].isin(sorted(runs["sequence"].unique())[streets])].copy()
        masked = runs["method"] == "masked"
        runs.loc[masked, ["se3", "rotation"]] *= factor
        monkeypatch.setattr(
            write_texts, "read_table", lambda name: runs if name.endswith("/runs") else read(name)
        )
        forget()

    def forget():
        write_texts.compared.cache_clear()
        write_texts.all_claims.cache_clear()

    yield change
    forget()


@pytest.mark.parametrize(
    "factor, streets, outcome",
    [
        (1e-3, slice(None), verdicts.LOWER),
        (1e3, slice(None), verdicts.HIGHER),
        (1, slice(4), verdicts.TOO_FEW),
    ],
)
def test_texts_say_every_outcome_of_the_runs(with_masks, factor, streets, outcome):
    with_masks(factor, streets)
    assert write_texts.verdict() == outcome
    readme, answer = map(write_texts.render, ("README.md.j2", "answer.md.j2"))
    said = f"rrors with masks are {write_texts.VERDICT_PHRASES[outcome]} those with all keypoints"
    assert said in readme and said in answer


def test_tables_made_from_tables_in_git_are_those_in_git():
    folder = write_texts.ROOT / "figures" / write_texts.REAL
    note, found = write_texts.data_note(), write_texts.all_claims()
    text = (folder / "claims.md").read_text(encoding="utf-8")
    assert text == claims.text_of_claims(found, note)
    names = [claim.name for claim in found]
    assert len(names) == len(set(names)) > 20 and {claim.word for claim in found} == set(
        claims.RULE
    )
    pairs = equal_number.table_of_pairs(
        write_texts.read_table(f"{write_texts.REAL}few_keypoints_runs"),
        write_texts.read_table(f"{write_texts.REAL}runs"),
    )
    table = (folder / "equal_number.md").read_text(encoding="utf-8")
    assert table.startswith(style.markdown(pairs)) and note in table


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
