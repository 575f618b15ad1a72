"""Studies of what people bring: true poses of another kind, own keypoints."""

import re

import cv2
import numpy as np
import pandas as pd
import pytest
from street import Street

from keypoint_study import sources
from keypoint_study.plan import Study
from keypoint_study.report import study_report as report
from keypoint_study.sources import Source
from thesis_repro import checks, odometry
from thesis_repro.command.cli import main
from thesis_repro.data.sequence import Sequence
from thesis_repro.data.trajectories import write_kitti_poses
from thesis_repro.errors import InputError
from thesis_repro.odometry.loop import VoteOfAll

pytestmark = pytest.mark.slow


@pytest.fixture
def no_figures(monkeypatch):
    """A study that draws nothing, which spares most of its time."""
    monkeypatch.setattr(report, "figures_of", lambda *_: ())


@pytest.fixture
def street(tmp_path):
    """A root with the street of noise as sequences 00 and 01, and one mask for all frames."""
    street, root = Street(12), tmp_path / "kitti"
    projection = np.column_stack([street.intrinsics, np.zeros(3)]).ravel().tolist()
    for name in ("00", "01"):
        folder = root / "sequences" / name / "image_0"
        folder.mkdir(parents=True)
        for index, image in enumerate(street.images):
            cv2.imwrite(str(folder / f"{index:06d}.png"), image)
        (folder.parent / "calib.txt").write_text(f"P0: {' '.join(map(str, projection))}\n")
        write_kitti_poses(root / f"poses/{name}.txt", street.poses)
        mask = np.zeros(street.size, np.uint8)
        mask[40:] = 255
        (tmp_path / "masks" / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "masks" / name / "mask.png"), mask)
    return root


def study(root, *options):
    """Run a small study; returns its exit code and the folder of its results."""
    out = root.parent / "out"
    few = ["--estimator", "thesis", "--repetitions", 1, "--jobs", 1, "--output", out]
    return main([*map(str, ["study", "--kitti", root, *few, *options])]), out


def test_an_own_search_beside_an_estimator_with_its_own_is_refused(street, tmp_path):
    file = tmp_path / "search.py"
    file.write_text("def find_essential_matrix(current, previous, threshold): return None, None")

    class Searching(VoteOfAll):
        search = staticmethod(odometry.OPENCV.find_essential_matrix)

    settings = odometry.OdometrySettings(estimator=Searching)
    with pytest.raises(InputError, match="search.py"):
        Source(file, "keypoints").run(Sequence(street, "00"), settings)


def test_a_truth_that_fits_better_inverted_ends_a_study_and_is_told(street, capsys):
    write_kitti_poses(street / "poses/00.txt", np.linalg.inv(Street(12).poses))
    code, _ = study(street, "--masks", street.parent / "masks")
    assert code == 1 and "poses/00.txt: the truth fits better" in capsys.readouterr().err
    assert main(["odometry", "--kitti", str(street), "--sequence", "00"]) == 0
    assert "the truth fits better" in capsys.readouterr().err


@pytest.mark.real
def test_a_real_truth_that_is_inverted_is_told(kitti_real):
    sequence = Sequence(kitti_real, "05").subset(40)
    estimated, true = odometry.run(sequence).poses, sequence.poses
    assert checks.inverted_truth(sequence, estimated) == []
    sequence._poses = np.linalg.inv(true)
    assert checks.inverted_truth(sequence, estimated)


DETECT = """
import cv2, numpy as np
def detect(frame, settings, mask):
    return {}
"""
CORNERS = "cv2.goodFeaturesToTrack(frame, 300, 0.01, 5)[:, 0]"
TRACK = """
def track(previous, current, points, settings):
    return {}
"""


@pytest.mark.parametrize(
    "text, said",
    [
        (
            DETECT.format(f"{CORNERS}[:, ::-1]"),
            "detect returned u .*, outside the frame of 480x160",
        ),
        (
            DETECT.format(f"{CORNERS}.astype(int)"),
            r"detect returned int64 \(\d+, 2\); must be float32",
        ),
        (DETECT.format(f"{CORNERS}[None]"), r"detect returned float32 \(1, \d+, 2\)"),
        (DETECT.format("cv2.ORB.create().detect(frame)"), "detect returned tuple; must be"),
        (DETECT.format("cv2.cvtColor(frame, 99999)"), "error: OpenCV"),
        (TRACK.format("points, [1] * len(points)"), "track returned .* and list"),
        (TRACK.format("points[1:], points[1:, 0] > 0"), "track returned float32"),
        (TRACK.format("points"), "own.py: "),
    ],
)
def test_own_functions_are_tried_before_the_study(street, text, said, capsys):
    path = street.parent / "own.py"
    path.write_text(text)
    code, out = study(street, "--keypoints", path)
    error = capsys.readouterr().err
    assert code == 1 and not out.exists()
    assert re.search(f"own.py: .*{said}|{said}", error) and "\\n" not in error
    assert error.count("own.py") == 1


@pytest.mark.usefixtures("no_figures")
def test_own_keypoints_are_drawn(street, capsys):
    path = street.parent / "own.py"
    path.write_text(DETECT.format(CORNERS))
    masks = street.parent / "masks"
    code, out = study(street, "--keypoints", f"own={path}", "--masks", masks, "--frames", 4)
    assert code == 0
    both = sources.named([("keypoints", "own", path), ("masks", None, masks)], None)
    planned = Study(street, ("00", "01"), both, (), frames=4)
    runs = pd.read_csv(out / "runs.csv", dtype={"sequence": str}, keep_default_na=False)
    figure = report.figure_of_sources(planned, runs).content
    own, masked = np.reshape(figure.axes, (2, 3))
    expected = cv2.goodFeaturesToTrack(Street(3).frame(2), 300, 0.01, 5)[:, 0]
    assert np.array_equal(own[2].collections[0].get_offsets(), expected)
    assert not own[1].images and masked[1].images


@pytest.mark.parametrize(
    "name, content, said",
    [
        ("features.h5", b"\x89HDF\r\n\x1a\n" + bytes(99), "must be a Python file"),
        ("net.pt", b"PK\x03\x04" + bytes(99), "must be a Python file"),
        ("folder.py", None, "must be a Python file"),
        ("wrong.py", b"def detect(frame, settings, mask)\n    return None\n", "SyntaxError"),
        ("data.py", b"\x89HDF\r\n" + bytes(99), "SyntaxError"),
        ("five.py", b"detector = 5", "must define"),
        ("other.py", b"import not_installed_here\n", "No module named 'not_installed_here'"),
    ],
)
def test_what_is_no_python_file_is_one_line(street, capsys, name, content, said):
    path = street.parent / name
    path.mkdir() if content is None else path.write_bytes(content)
    code, out = study(street, "--keypoints", path)
    *_, line = capsys.readouterr().err.splitlines()
    assert code == 1 and not out.exists() and line.startswith("error: ")
    assert re.search(rf"{name}(, line 1)?: ", line) and said in line


@pytest.mark.usefixtures("no_figures")
def test_own_keypoints_have_controls_of_equal_number_and_their_flags_are_told(street, capsys):
    path = street.parent / "own.py"
    path.write_text(DETECT.format(f"{CORNERS}[:5]"))  # too few
    code, out = study(street, "--keypoints", f"own={path}", "--controls", "--frames", 6)
    assert code == 0 and "sequence 00 own: " in capsys.readouterr().err
    runs = pd.read_csv(out / "runs.csv", dtype={"sequence": str}).set_index("method")
    number = runs.groupby("method")["mean_keypoints"].mean()
    assert set(runs.index) == {"baseline", "keypoints", "fewer", "spread"}
    assert number["fewer"] == pytest.approx(number["keypoints"], abs=1)


BREAKING = """
from thesis_repro.odometry.loop import detect as usual
calls = []
def detect(frame, settings, mask):
    calls.append(frame)
    if len(calls) > 5:
        raise ValueError("broken:\\n" + 300 * "x ")
    return usual(frame, settings, mask)
"""


@pytest.mark.usefixtures("no_figures")
def test_a_source_that_breaks_later_is_told_once_and_stays_in_the_summary(street, capsys):
    path = street.parent / "own.py"
    path.write_text(BREAKING)
    masks = ["--masks", f"net={street.parent / 'masks'}", "--controls", "--frames", 6]
    words = ["--keypoints", f"own={path}", "--sequences", "00", "--repetitions", 2]
    code, out = study(street, *words, *masks)
    lines = capsys.readouterr().err.splitlines()
    (line,) = [line for line in lines if "broken" in line]
    assert code == 1 and ",," not in line and "\\n" not in line
    assert "own.py, line 7: ValueError: broken: x x" in line
    table = pd.read_csv(out / "ratios.csv")
    masked = table[table["method"] == "masked"]
    assert "own" not in set(table["source"])
    assert set(masked["verdict"]) == {"too few sequences to tell"}
    page = (out / "index.html").read_text()
    assert page.count("own.py, line 7: ValueError") == 1 and "own: all runs failed" in page


@pytest.mark.parametrize("name", ["detect", "track", "find_essential_matrix"])
def test_an_error_in_own_code_is_told_with_its_line(tmp_path, street, name):
    path = tmp_path / "own.py"
    path.write_text(f"def {name}(*arguments, **named):\n    empty = []\n    return empty[3]\n")
    with pytest.raises(InputError, match=r"own\.py, line 3: IndexError"):
        Source(path, "keypoints").run(Sequence(street, "00").subset(4), odometry.THESIS)
