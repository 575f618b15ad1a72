"""Errors of several trajectories, compared with evo's command-line tools."""

import json
import logging
import re
import sys

import numpy as np
import pytest
from evo.cli import entry_points
from made_up import winding

from thesis_repro.command.cli import main
from thesis_repro.data.trajectories import write_kitti_poses, write_tum
from thesis_repro.errors import InputError
from thesis_repro.odometry import metrics
from thesis_repro.report import trajectories

EVO = {
    "none": [],
    "se3": ["--align"],
    "sim3": ["--align", "--correct_scale"],
    "scale": ["--correct_scale"],
}


@pytest.fixture
def files(tmp_path):
    """A folder with the ground truth of sequence 07, in kitti, and two estimates of it."""
    write_kitti_poses(tmp_path / "kitti/poses/07.txt", winding())
    for name, seed, stretch in (("good", 1, 1.0), ("long", 2, 1.2)):
        write_kitti_poses(tmp_path / f"{name}.txt", winding(seed=seed, stretch=stretch))
    return tmp_path


def evaluate(files, *options, names=("good.txt", "long.txt"), sequence="7"):
    words = ["evaluate", "--kitti", files / "kitti", "--sequence", sequence]
    return main([*map(str, words), *(str(files / name) for name in names), *map(str, options)])


def printed_by(tool, *arguments, monkeypatch, capsys):
    """The numbers that a tool of evo prints: {"rmse": 0.123456, ...}."""
    # handlers of the previous call print to another stream
    logging.getLogger("evo").handlers.clear()
    capsys.readouterr()
    monkeypatch.setattr(sys, "argv", [tool, *map(str, arguments)])
    getattr(entry_points, tool.removeprefix("evo_"))()
    return {
        name: float(value)
        for name, value in re.findall(r"(\w+)\t([0-9.e+-]+)", capsys.readouterr().out)
    }


@pytest.mark.slow
@pytest.mark.parametrize("alignment", EVO)
def test_errors_equal_those_of_evos_tools(files, alignment, monkeypatch, capsys):
    assert evaluate(files, "--align", alignment, "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["trajectory"] for row in rows] == [str(files / name) for name in ("good", "long")]
    for row in rows:
        arguments = [
            "kitti",
            files / "kitti/poses/07.txt",
            f"{row['trajectory']}.txt",
            *EVO[alignment],
        ]
        ape = printed_by("evo_ape", *arguments, monkeypatch=monkeypatch, capsys=capsys)
        rpe = printed_by("evo_rpe", *arguments, monkeypatch=monkeypatch, capsys=capsys)
        turns = printed_by(
            "evo_rpe", *arguments, "-r", "angle_deg", monkeypatch=monkeypatch, capsys=capsys
        )
        for key in ("rmse", "mean", "median", "max"):
            # evo prints six digits
            assert row[f"ate_{key}_m"] == pytest.approx(ape[key], abs=5.1e-7)
            assert row[f"rpe_translation_{key}_m"] == pytest.approx(rpe[key], abs=5.1e-7)
            assert row[f"rpe_rotation_{key}_deg"] == pytest.approx(turns[key], abs=5.1e-7)


def test_the_thesiss_rmse_is_printed(files, capsys):
    true, estimated = winding(), winding(seed=1)
    later = metrics.shifted(estimated, true)[1:]
    assert metrics.ate(later, true[1:])["rmse"] == pytest.approx(metrics.rmse(estimated, true))
    assert evaluate(files, "--align", "scale") == 0
    rows = {
        line.split()[0]: line.split()[1:] for line in capsys.readouterr().out.splitlines() if line
    }
    assert rows[str(files / "good")][2] == f"{metrics.rmse(estimated, true):.6f}"
    assert float(rows[str(files / "long")][-1]) == pytest.approx(1 / 1.2, abs=0.02)


def test_tum_keyframes_are_matched_by_time(files, capsys):
    kept, times = np.delete(np.arange(160), [3, 50, 51]), 0.1 * np.arange(160)
    # within the tolerance
    write_tum(files / "long.txt", winding(seed=1)[kept], times[kept] + 0.004)
    assert evaluate(files, "--json", "--plot", files / "both.svg") == 0
    out, err = capsys.readouterr()
    assert str(files / "both.svg") in err and (files / "both.svg").read_text().startswith("<?xml")
    good, keyframes = json.loads(out)
    assert (good["poses"], keyframes["poses"], keyframes["frames"]) == (160, 157, 160)
    assert keyframes["rmse_m"] == pytest.approx(
        metrics.rmse(winding(seed=1)[kept], winding()[kept])
    )
    # times of day; the error names the offset
    write_tum(files / "long.txt", winding(seed=1), times + 1.3e9 + 0.02)
    assert evaluate(files) == 1
    (offset,) = re.findall(r"long.txt: .* --t_offset (\S+)", capsys.readouterr().err)
    assert float(offset) == pytest.approx(-1.3e9 - 0.02)
    assert evaluate(files, "--json", "--t_offset", -1.3e9, "--t_max_diff", 0.03) == 0
    rmse = json.loads(capsys.readouterr().out)[1]["rmse_m"]
    assert rmse == pytest.approx(metrics.rmse(winding(seed=1), winding()))


def test_folders_of_sequences_get_a_mean(files, capsys):
    write_kitti_poses(files / "kitti/poses/08.txt", winding())
    for name, seed in (("07", 1), ("08", 2), ("11", 3)):  # 11 has no ground truth
        write_kitti_poses(files / f"ours/{name}.txt", winding(seed=seed))
    command = [
        "evaluate",
        "--kitti",
        str(files / "kitti"),
        str(files / "ours"),
        "--json",
        "--frames",
        "120",
    ]
    assert main(command) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["sequence"] for row in rows] == ["07", "08", "mean of 2"]
    values = [metrics.rmse(winding(seed=seed)[:120], winding()[:120]) for seed in (1, 2)]
    assert [row["rmse_m"] for row in rows] == pytest.approx([*values, np.mean(values)])
    assert rows[-1]["note"] == ""
    assert main([*command, "--sequence", "08"]) == 0
    assert [row["sequence"] for row in json.loads(capsys.readouterr().out)] == ["08"]
    (files / "kitti/poses").rename(files / "elsewhere")
    assert main(command) == 1 and "ours" in capsys.readouterr().err


def test_a_mean_over_fewer_sequences_says_so(files, capsys):
    for name, frames in (("07", 160), ("08", 20)):  # 19 m are too short for t_rel
        write_kitti_poses(files / f"kitti/poses/{name}.txt", winding()[:frames])
        write_kitti_poses(files / f"ours/{name}.txt", winding(seed=1)[:frames])
    command = ["evaluate", "--kitti", str(files / "kitti"), str(files / "ours")]
    assert main([*command, "--json"]) == 0
    long, short, mean = json.loads(capsys.readouterr().out)
    assert short["t_rel_percent"] is None and mean["t_rel_percent"] == long["t_rel_percent"]
    assert mean["note"] == "mean of only 1 of 2: t_rel_percent, r_rel_deg_per_100m"
    assert main(command) == 0 and mean["note"] in capsys.readouterr().out


def moved(poses, change):
    changed = poses.copy()
    changed[:, :3, 3] = change(changed[:, :3, 3])
    return changed


MIRROR = np.diag([-1.0, 1, 1, 1])


@pytest.mark.parametrize(
    "change",
    [
        lambda poses: moved(poses, lambda at: 100 * at),
        lambda poses: moved(poses, lambda at: 0.1 * at),
        lambda poses: moved(poses, lambda at: 2 * at),
        np.linalg.inv,
        lambda poses: poses[::-1],
        lambda poses: moved(poses, lambda at: at[:, ::-1]),
        lambda poses: MIRROR @ poses @ MIRROR,
        lambda poses: np.linalg.inv(poses[:-1, None]) @ poses[1:, None],
        None,
    ],
)
def test_a_doubtful_ground_truth_is_told(files, change, capsys):
    path, truth = files / "kitti/poses/07.txt", winding()
    write_kitti_poses(path, truth if change is None else change(truth).reshape(-1, 4, 4))
    write_kitti_poses(files / "good.txt", truth[: len(path.read_text().splitlines())])
    assert evaluate(files, names=["good.txt"]) == 0
    assert ("warning: " in capsys.readouterr().err) == (change is not None)


def tum(change):
    """Lines of a file in TUM's format with its numbers (160, 8) changed."""
    rows = np.zeros((160, 8))
    rows[:, 0], rows[:, 3], rows[:, 7] = 0.1 * np.arange(160), np.arange(160), 1
    return "\n".join(" ".join(map(repr, row)) for row in change(rows).tolist())


def doubled(rows):
    rows[5, 0] = rows[4, 0]
    return rows


# {file: its text}: what the error names; None if the files are evaluated
TIMES = "".join(f"{0.1 * index}\n" for index in range(160))
FILES = [
    ({"ours/07.txt~": "old", "ours/06.times": "0", "ours/07.tum": tum(np.array)}, None),
    ({"ours/07.tum": "\ufeff# t x y z\n" + tum(np.array)}, None),
    ({"ours/07.tum": tum(np.array), "ours/07.txt": "1"}, "07.t"),
    ({"ours/07.tum": tum(lambda rows: rows * [1000, 1, 1, 1, 1, 1, 1, 1])}, "07.tum: 1 of 160"),
    ({"ours/07.tum": tum(lambda rows: rows * [1, 1, 1, 1, 1, 1, 1, 0])}, "07.tum, pose 1"),
    ({"ours/07.tum": tum(lambda rows: rows * [1, 1, 1, 1e300, 1, 1, 1, 1])}, "07.tum, pose 2"),
    ({"ours/07.tum": tum(doubled)}, "07.tum, line 6"),
    ({"ours/07.tum": tum(np.array), "kitti/sequences/07/times.txt": TIMES + "16\n"}, "times.txt"),
    ({"ours/07.tum": tum(np.array), "kitti/sequences/07/times.txt": TIMES[:-5]}, "times.txt"),
]


@pytest.mark.parametrize("texts, named", FILES)
def test_files_that_would_give_wrong_numbers_are_refused(files, texts, named, capsys):
    for path, text in texts.items():
        (files / path).parent.mkdir(parents=True, exist_ok=True)
        (files / path).write_text(text, encoding="utf-8")
    assert main(
        ["evaluate", "--kitti", str(files / "kitti"), str(files / "ours"), "--json"]
    ) == bool(named)
    out, err = capsys.readouterr()
    assert named in err if named else [row["poses"] for row in json.loads(out)] == [160]


def test_two_formats_of_one_name_and_means_over_other_sequences(files, capsys):
    write_kitti_poses(files / "kitti/poses/08.txt", winding())
    for path in ("ours/07.txt", "ours/08.txt", "both/07.txt", "both/08.txt", "both/09.txt"):
        write_kitti_poses(files / path, winding(seed=1))
    write_kitti_poses(files / "kitti/poses/09.txt", winding())
    write_tum(files / "good.tum", winding(seed=2), 0.1 * np.arange(160))
    command = ["evaluate", "--kitti", str(files / "kitti"), "--json"]
    assert main([*command, str(files / "ours"), str(files / "both")]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["sequence"] for row in rows[5:]] == ["mean of 07, 08", "mean of 07, 08, 09"]
    assert evaluate(files, "--json", names=["good.txt", "good.tum"]) == 0
    assert len({row["rmse_m"] for row in json.loads(capsys.readouterr().out)}) == 2


def test_trajectories_that_cannot_be_compared_are_named(files, capsys):
    straight = np.tile(np.eye(4), (160, 1, 1))
    write_kitti_poses(files / "long.txt", straight)
    assert evaluate(files, "--align", "se3") == 0
    assert "long: " in capsys.readouterr().out.splitlines()[-1]  # a straight path has no alignment
    write_kitti_poses(files / "long.txt", straight[:9])
    for options, named in (([], "long.txt: 9"), (["--plot", files / "both.doc"], "both.doc")):
        assert evaluate(files, *options) == 1
        assert named in capsys.readouterr().err
    assert evaluate(files, sequence="11") == 1
    assert "poses/11.txt" in capsys.readouterr().err
    with pytest.raises(InputError, match="alignment='sim'"):
        trajectories.evaluate({"good": (np.arange(160), winding())}, winding(), "sim")
