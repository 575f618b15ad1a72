"""README and the answer are those of their templates, short, and follow the tables."""

import cv2
import numpy as np
import pytest

import thesis_repro as tr
import write_texts
from keypoint_study import verdicts
from thesis_repro.odometry import metrics


@pytest.mark.parametrize(
    "template, words",
    [
        ("README.md.j2", 900),
        ("answer.md.j2", 1200),
        ("reading-results.md.j2", 2600),
        ("options.md.j2", 1800),
    ],
)
def test_texts_in_git_are_those_of_the_tables_and_short(template, words):
    written = write_texts.WRITTEN[template].read_text(encoding="utf-8")
    assert written.splitlines() == write_texts.render(template).splitlines()
    assert len(written.split()) <= words


@pytest.fixture
def with_masks(monkeypatch):
    """A function that multiplies the errors with masks, on the given streets or on all."""
    read = write_texts.read_table

    def change(factor, streets=slice(None)):
        runs = read(f"{write_texts.REAL}runs")
        runs = runs[runs["sequence"].isin(sorted(runs["sequence"].unique())[streets])].copy()
        masked = runs["method"] == "masked"
        runs.loc[masked, ["se3", "rotation"]] *= factor
        monkeypatch.setattr(
            write_texts, "read_table", lambda name: runs if name.endswith("/runs") else read(name)
        )
        write_texts.compared.cache_clear()

    yield change
    write_texts.compared.cache_clear()


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
    assert f"masks are {write_texts.ERRORS[outcome]} those" in readme
    assert write_texts.PATHS[outcome] in answer


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
