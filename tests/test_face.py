"""What the package offers by name, and the example on the front page."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import thesis_repro as tr
from thesis_repro.cityscapes import read_label_map

ROOT = Path(__file__).resolve().parent.parent
README = ROOT / "README.md"


def test_what_is_offered_is_there():
    assert set(tr.__all__) <= set(dir(tr))
    assert tr.THESIS == tr.OdometrySettings() and tr.Sequence.__module__ == "thesis_repro.kitti"
    assert tr.keypoint_mask(np.full((8, 8), 7, np.uint8), (16, 32), 3).shape == (16, 32)
    assert tr.build_unet((32, 32, 1), 35, 2).output_shape == (None, 32, 32, 35)


def test_tensorflow_is_not_loaded_before_it_is_asked_for():
    code = ("import sys, thesis_repro as tr; tr.Sequence, tr.keypoint_mask, tr.Odometry, tr.THESIS, tr.run; "
            "assert 'tensorflow' not in sys.modules and 'keras' not in sys.modules; tr.build_unet; "
            "assert 'keras' in sys.modules")
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True)


def test_an_unknown_name_is_an_ordinary_attribute_error():
    assert not hasattr(tr, "mistyped")


def test_bad_input_is_one_line_in_a_notebook():
    assert tr.InputError("frames: none")._render_traceback_() == ["InputError: frames: none"]


def test_the_example_of_the_readme_runs(small_world, tmp_path, monkeypatch, capsys):
    (example,) = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    (tmp_path / "world").symlink_to(small_world)
    monkeypatch.chdir(tmp_path)

    def label_map_of(index):
        return read_label_map(small_world / "kitti" / "sequences" / "00" / "labels_0" / f"{index:06d}.png")

    names = {"label_map_of": label_map_of}
    exec(example, names)
    assert len(names["every"].poses) == len(names["masked"].poses) == 12
    assert names["masked"].frames["detected"].mean() < names["every"].frames["detected"].mean()
    assert len(example.splitlines()) <= 14 and capsys.readouterr().out


@pytest.mark.parametrize("heading, folder", [("What the default run shows", "figures"),
                                             ("On real frames", "figures/kitti_excerpts"),
                                             ("Keypoint masks", "figures/kitti_excerpts")])
def test_every_number_of_a_result_stands_in_what_a_command_writes(heading, folder):
    """Ratios, those with an interval together with it, and numbers of frames and keypoints."""
    sections = re.split(r"^#+ ", README.read_text(), flags=re.MULTILINE)
    (section,) = [text for text in sections if text.startswith(heading)]
    section = re.sub(r"\]\(.*?\)", "]", section)  # links
    written = " ".join((ROOT / folder / name).read_text() for name in ("findings.md", "answer_in_words.md"))
    written = re.sub(r"\[(\S+), (\S+)\]", r"(\1 to \2)", written)  # as the answer writes intervals
    number = r"\d+\.\d+"
    ratios = re.findall(rf"({number})[^()]{{0,40}}? (\({number} to {number}\))", section)
    assert ratios
    for ratio, interval in ratios:
        assert f"{ratio} {interval}" in written, (ratio, interval)
    card = (ROOT / "thesis_repro" / "segmentation" / "weights" / "README.md").read_text()  # of the label maps
    rounded = {f"{float(value):.2f}" for value in re.findall(rf"mean IoU \*\*({number})", card)}
    assert set(re.findall(number, section)) <= set(re.findall(number, written)) | rounded
    for count in re.findall(r"\b\d{3,4}(?= (?:frames|real frames|keypoints))", section):
        assert re.search(rf"\b{count}\b", written), count
