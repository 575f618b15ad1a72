"""The commands and Python examples of the README and of docs run."""

import re
import shlex

import cv2
import numpy as np
import pandas as pd
import pytest

from thesis_repro.command import cli
from thesis_repro.command.options import build_parser
from thesis_repro.report import texts
from thesis_repro.running.settings import ROOT

TEXTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def blocks(path, language):
    return re.findall(rf"```{language}\n(.*?)```", path.read_text(encoding="utf-8"), re.DOTALL)


@pytest.mark.parametrize("path", TEXTS, ids=lambda path: path.name)
def test_commands_in_texts_have_their_options(path):
    parser = build_parser(cli.COMMANDS)
    for block in blocks(path, "sh"):
        for line in block.replace("\\\n", " ").splitlines():
            program, *words = shlex.split(line, comments=True) or [""]
            if program.endswith("thesis-repro"):
                assert parser.parse_args(words).command


def test_the_example_of_the_readme_compares_three_paths(small_world, tmp_path, monkeypatch, capsys):
    (example,) = blocks(ROOT / "README.md", "python")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "world").symlink_to(small_world)
    (tmp_path / "labels").symlink_to(small_world / "kitti/sequences/00/labels_0")
    names = {}
    exec(example, names)
    paths = names["baseline"], names["masked"], names["few"]
    assert [len(path.poses) for path in paths] == [12, 12, 12]
    every, masked, few = [path.frames["detected"].mean() for path in paths]
    assert few == 200 and 200 < masked < every
    assert len(capsys.readouterr().out.splitlines()) == 3


EVIDENCE = ROOT / "figures/kitti_excerpts"
MASKS = {"keypoints": "masks, width 10"}
ALL = {"over": "all keypoints"}
REFINED, THESIS = {"estimator": "refined estimator"}, {"estimator": "thesis's estimator"}
BOTH = ("aligned ATE", "rotation error a frame")
COUNTS = ("aligned ATE: above 1", "failed runs", "failed runs of the reference")
FEW = (
    "aligned ATE, refined estimator",
    "rotation error a frame, refined estimator",
    "aligned ATE, thesis's estimator",
    "rotation error a frame, thesis's estimator",
)
SPREAD = {"how chosen": "spread over the frame", "keypoints": "200"}
# (text, table on real frames, row, columns whose numbers the text gives)
NUMBERS = [
    ("README.md", "comparison", {**MASKS, **ALL, **REFINED}, BOTH),
    ("docs/answer.md", "comparison", {**MASKS, **ALL, **REFINED}, (*BOTH, "RMSE", *COUNTS)),
    ("docs/answer.md", "comparison", {**MASKS, **ALL, **THESIS}, (*BOTH, "RMSE", *COUNTS)),
    ("docs/answer.md", "comparison", {**MASKS, "over": "edges of the image", **REFINED}, BOTH[1:]),
    (
        "docs/answer.md",
        "comparison",
        {**MASKS, "over": "keypoints spread out", **REFINED},
        BOTH[1:],
    ),
    ("docs/answer.md", "comparison", {**MASKS, "over": "fewer keypoints", **REFINED}, BOTH[1:]),
    *(
        ("docs/answer.md", "comparison", {"keypoints": method, **ALL, **REFINED}, BOTH)
        for method in (
            "corrected mask",
            "exact class boundaries",
            "fewer keypoints",
            "all but movable things",
            "all but the boundaries",
            "boundaries of static things",
        )
    ),
    (
        "docs/answer.md",
        "comparison",
        {"keypoints": "fewer keypoints", **ALL, **THESIS},
        (*BOTH, "RMSE", "failed runs"),
    ),
    *(
        ("docs/answer.md", "few_keypoints", {"how chosen": chosen, "keypoints": number}, FEW)
        for chosen, number in (
            ("spread over the frame", "200"),
            ("spread over the frame", "100"),
            ("random ones", "400"),
            ("random ones", "200"),
            ("the strongest", "200"),
            ("the strongest on the mask", "199"),
            ("the strongest on the mask", "790"),
            ("mask, filled to 5 a field", "926"),
        )
    ),
    ("README.md", "table_4_2", {"sequence": "mean"}, ("change (%)", "change (%), one run each")),
    ("docs/answer.md", "table_4_2", {"sequence": "median"}, ("change (%)",)),
    ("README.md", "few_keypoints", {"how chosen": "all keypoints"}, ("keypoints",)),
    *(
        ("docs/answer.md", "few_keypoints", row, ("CPU time a frame (ms)",))
        for row in ({"keypoints": "1894"}, SPREAD, {"keypoints": "790"})
    ),
]


@pytest.mark.parametrize("text, table, row, columns", NUMBERS)
def test_numbers_in_texts_are_those_of_the_tables(text, table, row, columns):
    words = (ROOT / text).read_text(encoding="utf-8")
    rows = pd.read_csv(EVIDENCE / f"{table}.csv", dtype=str)
    (line,) = rows[(rows[list(row)] == pd.Series(row)).all(axis=1)].to_dict("records")
    for column in columns:
        for number in re.findall(r"[\d.]+", line[column].partition(",")[0]):
            shown = number
            if table == "table_4_2":  # texts have one digit
                shown = f"{float(number):.1f}"
            assert shown in words, f"{column}: {line[column]}"


@pytest.mark.parametrize(
    "quantity, metric",
    [
        ("half turned into over all keypoints", "rotation error in turns"),
        ("half turned into over the other half", "rotation error in turns"),
        ("far keypoints left out (parallax below 3 pixels), over all", BOTH[1]),
        ("far keypoints left out (parallax below 3 pixels), over as many at random", BOTH[1]),
        ("near keypoints left out (parallax of 20 pixels or more), over all", BOTH[1]),
    ],
)
def test_the_answer_has_the_numbers_of_the_audit(quantity, metric):
    rows = pd.read_csv(EVIDENCE / "audit.csv")
    chosen = {"quantity": quantity, "metric": metric, "estimator": "refined"}
    (row,) = rows[(rows[list(chosen)] == pd.Series(chosen)).all(axis=1)].to_dict("records")
    shown = "{} ({}-{})".format(*(texts.number(row[end]) for end in ("value", "low", "high")))
    assert shown in (ROOT / "docs/answer.md").read_text(encoding="utf-8")


def test_texts_have_the_measured_times():
    budget = pd.read_csv(EVIDENCE / "budget.csv").set_index("stage")
    whole = budget.loc["all stages (ms)"]
    odometry = budget.loc[["mask (ms)", "detection (ms)", "tracking (ms)", "pose (ms)"]].sum()
    every, masked = odometry["all keypoints"], odometry["masked, width 10"]
    saved, factor = round(100 - 100 * masked / every), whole["masked, width 10"] / whole.iloc[0]
    answer = (ROOT / "docs/answer.md").read_text(encoding="utf-8")
    assert f"{masked:.1f} ms a frame in place of {every:.1f} (-{saved} %" in answer
    for text in (answer, (ROOT / "README.md").read_text(encoding="utf-8")):
        assert f"{saved} %" in text and f"{factor:.1f} times as long" in text


def test_the_first_training_is_that_of_the_comparison():
    trainings = pd.read_csv(ROOT / "figures/trainings.csv")
    compared = pd.read_csv(ROOT / "figures/comparison.csv")
    for row in trainings[trainings["training"] == "seed 0"].itertuples():
        is_same = compared["estimator"].str.startswith(row.estimator)
        is_same &= (compared["keypoints"] == "masks, width 10") & (compared["over"] == ALL["over"])
        (line,) = compared[is_same].to_dict("records")
        for column, name in (("se3", "aligned ATE"), ("rotation", "rotation error a frame")):
            ends = [getattr(row, f"{column}_{end}") for end in ("ratio", "low", "high")]
            assert line[name] == "{:.2f} ({:.2f}-{:.2f})".format(*ends)


@pytest.fixture
def examples(small_world, tmp_path, monkeypatch):
    """The Python examples on own masks, run in a folder with frames and a video of a drive."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "frames").symlink_to(small_world / "kitti/sequences/00/image_0")
    images = [cv2.imread(str(path)) for path in sorted((tmp_path / "frames").iterdir())]
    height, width = images[0].shape[:2]
    video = cv2.VideoWriter("drive.mp4", cv2.VideoWriter_fourcc(*"mp4v"), 25, (width, height))
    for image in images:
        video.write(image)
    video.release()
    results = []
    for example in blocks(ROOT / "docs/own-masks.md", "python"):
        names = {}
        exec(example, names)
        results.append(names)
    return images, results


def test_the_examples_on_own_masks_run(examples, tmp_path):
    images, (masks, calls, _) = examples
    step, mask = masks["step"], masks["mask_of"](images[-1][..., 0])
    u, v = step.keypoints.astype(int).T
    assert len(u) > 100 and mask[v, u].all()
    assert step.previous.shape == step.current.shape == (len(step.inliers), 2)
    assert 10 < np.linalg.norm(step.pose[:3, 3]) < 11.1  # eleven steps of a metre
    picture = cv2.imread("keypoints.png")
    assert np.count_nonzero((picture != picture[..., :1]).any(axis=2)) > 1000
    for image in images[:3]:
        step = calls["odometry"].step(image[..., 0], 1.0)
    assert step.updated and step.inliers.sum() > 50
    first = cv2.imread("my-drive/000000.png", cv2.IMREAD_UNCHANGED)
    assert len(list((tmp_path / "my-drive").iterdir())) == len(images)
    assert first.ndim == 2 and first.dtype == np.uint8
