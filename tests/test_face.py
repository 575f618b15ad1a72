"""The public names of the package, and the example and the numbers of the README."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import thesis_repro as tr

ROOT = Path(__file__).resolve().parent.parent


def test_public_names():
    assert set(tr.__all__) <= set(dir(tr)) and not hasattr(tr, "mistyped")
    assert tr.THESIS == tr.OdometrySettings() and tr.Sequence.__module__ == "thesis_repro.kitti"
    assert tr.keypoint_mask(np.full((8, 8), 7, np.uint8), (16, 32), 3).shape == (16, 32)
    assert tr.build_unet((32, 32, 1), 35, 2).output_shape == (None, 32, 32, 35)


def test_tensorflow_is_loaded_on_first_use():
    code = (
        "import sys, thesis_repro as tr; tr.Sequence, tr.keypoint_mask, tr.Odometry, tr.THESIS, tr.run; "
        "assert 'tensorflow' not in sys.modules and 'keras' not in sys.modules; tr.build_unet; "
        "assert 'keras' in sys.modules"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_bad_input_is_one_line_in_a_notebook():
    assert tr.InputError("frames: none")._render_traceback_() == ["InputError: frames: none"]


CAMERA = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
MAP, FRAME = np.full((8, 8), 7, np.uint8), np.eye(96, 128, dtype=np.uint8)


@pytest.mark.parametrize(
    "call, named",
    [
        (lambda: tr.keypoint_mask(np.zeros((8, 8, 35), np.uint8), (16, 32), 3), "label map"),
        (lambda: tr.keypoint_mask(MAP + 30, (16, 32), 3), "label map"),
        (lambda: tr.keypoint_mask(MAP, (16, 32, 3), 3), "size"),
        (lambda: tr.keypoint_mask(MAP, (16, 32.0), 3), "size"),
        (lambda: tr.keypoint_mask(MAP, (16, 0), 3), "size"),
        (lambda: tr.keypoint_mask(MAP, (16, 32), 3, {"ids": "train"}), "settings"),
        (lambda: tr.Odometry(CAMERA.T), "intrinsics"),
        (lambda: tr.Odometry(-CAMERA), "intrinsics"),
        (lambda: tr.Odometry(np.eye(3)).step(FRAME), "intrinsics"),
        (lambda: tr.Odometry(CAMERA, [MAP]), "settings"),
        (lambda: tr.Odometry(CAMERA, start=2 * np.eye(4)), "start"),
        (lambda: tr.Odometry(CAMERA, start=np.eye(4) + np.eye(4, k=-1)[::-1]), "start"),
        (lambda: tr.Sequence("kitti", 7), "sequence"),
    ],
)
def test_wrong_arguments_are_named(call, named):
    with pytest.raises(tr.InputError, match=named):
        call()


def test_the_example_of_the_readme_runs(small_world, tmp_path, monkeypatch, capsys):
    (example,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (tmp_path / "world").symlink_to(small_world)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "labels").symlink_to(small_world / "kitti/sequences/00/labels_0")
    names = {}
    exec(example, names)
    assert len(names["baseline"].poses) == len(names["masked"].poses) == 12
    assert names["masked"].frames["detected"].mean() < names["baseline"].frames["detected"].mean()
    assert len(example.splitlines()) <= 14 and capsys.readouterr().out


@pytest.mark.parametrize("text", ["README.md", "docs/answer.md"])
def test_ratios_in_texts_are_in_recorded_tables(text):
    """Each "1.09 (95 % CI 0.98-1.32)" is in one line of a table that `make figures` does not
    rewrite, rounded to two digits.
    """
    ratios = re.findall(
        r"(\d+\.\d\d) \(95 % CI (\d+\.\d\d)-(\d+\.\d\d)\)", (ROOT / text).read_text()
    )
    recorded = [
        ROOT / "figures/trainings.csv",
        *(ROOT / "figures/kitti_excerpts").glob("*.[cm][sd]*"),
    ]
    rows = [
        {f"{float(number):.2f}" for number in re.findall(r"\d+\.\d+", line)}
        for path in recorded
        for line in path.read_text().splitlines()
    ]
    assert (
        ratios and [ratio for ratio in ratios if not any(set(ratio) <= row for row in rows)] == []
    )
