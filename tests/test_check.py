import re
import shutil

import cv2
import numpy as np

from thesis_repro import files
from thesis_repro.__main__ import main
from thesis_repro.check import check_cityscapes, check_kitti


def test_sound_data_has_no_problems(tiny_kitti, tiny_cityscapes):
    for deep, frames, labels in ((False, "4 frames of 64x48", "labels in the first and last"),
                                 (True, "4 frames of 64x48, all decoded", "labels")):
        facts, problems = check_kitti(tiny_kitti, deep)
        assert problems == [] and facts == [
            f"sequence 00: {frames}; an excerpt: the complete sequence has 4541; not the thesis's size of 1241x376",
            "can be run: odometry, predict and masks with 00",
            f"can be run: evaluate, boresight, study and plan with 00; make figures KITTI={tiny_kitti}"]
        facts, problems = check_cityscapes(tiny_cityscapes, deep)
        assert problems == [] and facts[::2] == [
            f"split train: 4 images with label maps; {labels}: road 7, building 11, sky 23",
            f"can be run: make figures CITYSCAPES={tiny_cityscapes}"]


def test_every_problem_is_listed_and_the_exit_code_says_so(tiny_kitti, tiny_cityscapes, capsys):
    frame = tiny_kitti / "sequences/00/image_0/000001.png"
    frame.write_bytes(frame.read_bytes()[:100])
    cv2.imwrite(str(tiny_kitti / "sequences/00/image_0/000003.png"), np.zeros((9, 9), np.uint8))
    (tiny_kitti / "sequences/00/times.txt").write_text("0\n0.1\n0.1\n0.2\n")
    (tiny_kitti / "poses/00.txt").write_text("1 0 0 0 0 2 0 0 0 0 1 0\n" * 4)
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_0.png"), np.full((16, 32), 200, np.uint8))
    cv2.imwrite(str(tiny_cityscapes / "valannot/street_1.png"), np.full((8, 8), 7, np.uint8))
    assert main(["check-data", "--kitti", str(tiny_kitti), "--cityscapes", str(tiny_cityscapes)]) == 1
    problems = [line for line in capsys.readouterr().err.splitlines() if line.startswith("wrong: ")]
    patterns = ["000001.png: the image is truncated", "000003.png: 9x9 pixels", "times.txt, line 3: time does not",
                "00.txt, line 1: is no rotation", "street_0.png: label id 200", "street_1.png: 8x8 pixels, but"]
    assert len(problems) == len(patterns)
    for pattern in patterns:
        assert any(re.search(pattern, problem) for problem in problems), pattern


def flip_a_byte(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_damage_in_the_middle_is_found_by_a_deep_look_alone(tiny_kitti, tiny_cityscapes, monkeypatch):
    frame, label = tiny_kitti / "sequences/00/image_0/000001.png", tiny_cityscapes / "trainannot/street_1.png"
    flip_a_byte(frame)
    cv2.imwrite(str(label), np.full((16, 32), 200, np.uint8))
    decoded = []
    original = files._decoded
    monkeypatch.setattr(files, "_decoded", lambda path, *rest: (decoded.append(path), original(path, *rest))[1])
    assert check_kitti(tiny_kitti)[1] == check_cityscapes(tiny_cityscapes)[1] == []
    assert len(decoded) == 2 + 2 * 4  # the first and last frame; the first and last pair of each of two splits
    facts, problems = check_kitti(tiny_kitti, deep=True)
    assert len(problems) == 1 and problems[0].startswith(f"{frame}: the image is truncated or corrupt")
    assert "cannot be run: odometry, predict and masks" in facts
    facts, problems = check_cityscapes(tiny_cityscapes, deep=True)
    assert len(problems) == 1 and f"{label}: label id 200" in problems[0] and "cannot be run: " in facts[-1]


def test_what_is_missing_is_counted_and_named(tiny_kitti, tiny_cityscapes):
    images = tiny_kitti / "sequences/00/image_0"
    for index in range(4, 40):
        shutil.copy(images / "000000.png", images / f"{index:06d}.png")
    (tiny_kitti / "sequences/00/times.txt").write_text("".join(f"{index}\n" for index in range(40)))
    (tiny_kitti / "poses/00.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n" * 40)
    assert check_kitti(tiny_kitti)[1] == []
    for index in (0, 3, 4, 5, 9, 38, 39):
        (images / f"{index:06d}.png").unlink()
    facts, problems = check_kitti(tiny_kitti)
    assert problems == [f"{images}: 000000.png, 000003.png to 000005.png, 000009.png, 000038.png to 000039.png are "
                        "missing (7 in all), copy them again"]
    assert facts[0].startswith("sequence 00: 33 of 40 frames of 64x48")
    for index in range(4):
        (tiny_cityscapes / "trainannot" / f"street_{index}.png").unlink()
    for index in range(12):
        (tiny_cityscapes / "val" / f"lonely_{index}.png").write_bytes(b"")
    counts = [len(check_cityscapes(tiny_cityscapes, deep)[1]) for deep in (False, True)]
    # four images without label maps and so no pair; of twelve such ones ten are named, and the count of the others
    assert counts == [4 + 1 + 11, 4 + 1 + 12]


def test_street_scenes_need_no_validation_split(tiny_cityscapes, capsys):
    for split in ("val", "valannot"):
        for path in (tiny_cityscapes / split).iterdir():
            path.unlink()
    assert main(["check-data", "--kitti-semantic", str(tiny_cityscapes)]) == 0
    assert "split train: 4 images with label maps" in capsys.readouterr().out
    assert main(["check-data", "--cityscapes", str(tiny_cityscapes)]) == 1
    (tiny_cityscapes / "trainannot" / "street_0.png").unlink()
    capsys.readouterr()
    assert main(["check-data", "--kitti-semantic", str(tiny_cityscapes)]) == 1
    assert "has no label map" in capsys.readouterr().err


def test_wrong_camera_is_noticed(tiny_kitti):
    for index in range(4):
        cv2.imwrite(str(tiny_kitti / f"sequences/00/image_0/{index:06d}.png"), np.zeros((376, 1241), np.uint8))
    _, problems = check_kitti(tiny_kitti)
    assert len(problems) == 1 and "calib.txt: the camera differs from the thesis's by" in problems[0]


def test_sequences_without_truth_are_described_and_missing_poses_named(tiny_kitti):
    shutil.copytree(tiny_kitti / "sequences/00", tiny_kitti / "sequences/11")
    (tiny_kitti / "sequences/11/times.txt").unlink()
    (tiny_kitti / "sequences/11/image_0").rename(tiny_kitti / "sequences/11/image_2")
    (tiny_kitti / "sequences/11/calib.txt").write_text("P2: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    facts, problems = check_kitti(tiny_kitti)
    assert problems == [] and facts[1].startswith("sequence 11: 4 frames of 64x48; no true poses, so the study passes "
                                                  "it over")
    assert "1 m; no times.txt, so 10 frames a second; the frames of image_2, read as gray" in facts[1]
    assert facts[2] == "can be run: odometry, predict and masks with 00, 11"
    (tiny_kitti / "poses/00.txt").unlink()
    facts, problems = check_kitti(tiny_kitti)
    assert len(problems) == 1 and "poses/00.txt: no such file" in problems[0]
    assert facts[-2:] == ["can be run: odometry, predict and masks with 11",
                          "cannot be run: evaluate, boresight, study and plan; make figures needs all sequences "
                          "without fault, so mend or move away the others"]
    shutil.rmtree(tiny_kitti / "sequences/00")
    facts, problems = check_kitti(tiny_kitti)
    assert len(facts) == 3 and len(problems) == 1 and "no sequence holds frames" in problems[0]


def test_a_missing_folder_is_one_line(tmp_path, capsys):
    assert main(["check-data", "--kitti", str(tmp_path / "nowhere")]) == 1
    assert main(["check-data"]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert "nowhere: holds no folder 'sequences'" in first and "nothing to check" in second
