"""The plan: counted from the job lists that are run, and near what a run then really takes."""

import time

import cv2
import numpy as np
import pytest

from thesis_repro import InputError, kitti, stages
from thesis_repro.cli import main
from thesis_repro.study import plan, runner
from thesis_repro.study.jobs import first_jobs, mask_control_jobs
from thesis_repro.study.sources import Source

pytestmark = pytest.mark.slow

SERIES = plan.FIRST_SERIES, plan.SECOND_SERIES
EXCERPT = plan.Excerpt("00 from frame 2", jobs=dict(zip(SERIES, (168, 30))),
                       series=dict(zip(SERIES, (1.68 + 0.05, 0.3 + 0.05))), shared=0.05, row_bytes=500.0,
                       worker_bytes=200_000_000)
MODELS = plan.SHIPPED, plan.OWN
CALIBRATION = plan.Calibration([EXCERPT], timing=0.5, networks=dict.fromkeys(MODELS, 1.0), network_bytes=2_000_000_000,
                               label_bytes=6000.0, seconds=30.0, training=3.0, training_bytes=9_000_000_000)


def test_the_complete_benchmark_is_added_up(tmp_path):
    work = plan.Thesis(tmp_path, (), repetitions=2)
    made = plan.make(work, kitti.FRAME_COUNTS, CALIBRATION, (1, 4, 64), training_images=2975)
    # 34 thesis runs without the 2 reduced, refined baseline and masks, 6 mask controls under both estimators
    assert made.jobs == dict(zip(SERIES, (11 * (32 + 4 + 24), 11 * (2 + 4 + 4))))
    assert made.label_hours == dict.fromkeys(MODELS, pytest.approx(23201 / 3600))
    # one pass a sequence: what all share, and a hundredth of a second a job
    assert made.odometry_hours == pytest.approx(dict(zip(SERIES, (23201 * (0.05 + 0.60) / 3600,
                                                                  23201 * (0.05 + 0.1) / 3600))))
    assert made.timing_hours == pytest.approx(11 * 200 * 0.5 / 3600)
    assert made.label_bytes == 23201 * 6000 and made.result_bytes == pytest.approx(23201 * 70 * 500)
    hours = made.wall_hours
    assert hours[1] == pytest.approx(sum(made.odometry_hours.values()) + made.timing_hours)
    assert hours[1] / 4 < hours[4] < hours[1] / 3 and hours[64] < hours[4]
    # no faster than the longest sequence with what no cut can take from it
    assert hours[64] * 3600 > 2 * 4661 * 0.05
    assert made.memory_bytes[64] > made.memory_bytes[4] > made.worker_bytes[4] > 200_000_000
    # the thesis's 4760 images for 100 epochs, and 1190 to validate with
    assert made.training_images == 4760
    assert made.training_hours == pytest.approx(100 * (4760 * 3 + 1190 * 1) / 3600)
    text = plan.text(work, made, CALIBRATION, complete=True)
    assert "its training, up to 100 epochs of 4,760 images" in text and "a training batch of 16 at least 9.0 GB" in text
    assert f"{made.training_hours + sum(made.odometry_hours.values()) + made.timing_hours + 23201 / 3600:.2f}" in text


def test_workers_take_what_comes_next():
    assert plan._schedule([4, 3, 3, 2], 2) == 6
    assert plan._schedule([4, 3, 3, 2], 1) == 12
    assert plan._schedule([4, 3], 8) == 4


def test_the_excerpts_are_spread_over_all_frames(small_world):
    work = plan.Thesis(small_world / "kitti", ("00", "01"))
    places = [(sequence.name, start) for sequence, start in plan._places(work)]
    assert places == [("00", 4), ("01", 0), ("01", 6)]  # frames 4, 12 and 20 of 24; the last as far as it goes


def test_an_excerpt_is_the_frames_it_names(small_world, tmp_path):
    sequence = kitti.Sequence(small_world / "kitti", "01")
    plan._copy(sequence, 3, tmp_path / "kitti")
    excerpt = kitti.Sequence(tmp_path / "kitti", plan.NAME)
    assert len(excerpt) == plan.FRAMES and np.array_equal(excerpt.frame(1), sequence.frame(4))
    assert np.array_equal(excerpt.poses, sequence.poses[3:3 + plan.FRAMES])
    assert np.array_equal(excerpt.intrinsics, sequence.intrinsics)


@pytest.fixture
def quick(monkeypatch):
    """The thesis's plan with one width and no network of 64 filters, so that it takes seconds."""
    monkeypatch.setattr(plan, "EXCERPTS", 1)
    monkeypatch.setattr(plan, "NETWORK_IMAGES", 1)
    monkeypatch.setattr(plan, "_own_model", lambda sizes: plan._shipped_model())
    monkeypatch.setattr(plan, "_training", lambda *_: (2.0, 1_000_000))


def test_the_command_prints_a_table(small_world, quick, capsys, monkeypatch):
    monkeypatch.setenv("THESIS_REPRO_REPETITIONS", "1")
    monkeypatch.setattr(plan, "CORES", (2, 6))
    assert main(["plan", "--kitti", str(small_world / "kitti")]) == 0
    text = capsys.readouterr().out
    assert "2 sequences, 24 frames" in text and "--complete plans for it" in text
    # 16 runs, 2 refined ones and 14 controls, the true label maps among them, for each of two sequences
    assert f"{2 * (16 + 2 + 14)} runs" in text and f"{2 * 5} runs" in text
    table = text[text.index("cores  odometry"):text.index("\n\ndisk")].splitlines()[1:]
    assert [int(line.split()[0]) for line in table] == [1, 2, 6]


def test_the_calibration_is_near_what_a_run_takes(small_world, tmp_path):
    """Loosely, since machines are busy: the excerpt is from the same world as the runs that it stands for."""
    sequence = kitti.Sequence(small_world / "kitti", "00")
    plan._copy(sequence, 0, tmp_path / "excerpt" / "kitti")
    labels = stages.stage(tmp_path / "excerpt" / "labels" / plan.NAME)
    more = stages.stage(tmp_path / "labels" / "00")
    for path in sequence.frame_paths:
        label_map = cv2.imread(str(sequence.folder / "labels_0" / path.name), 0)
        cv2.imwrite(str(labels / path.name), label_map)
        cv2.imwrite(str(more / path.name), label_map)
    with plan.ProcessPoolExecutor(1, plan.get_context("spawn")) as pool:
        work = plan.Thesis(tmp_path / "excerpt" / "kitti", (plan.NAME,), repetitions=1,
                           sources=(Source(tmp_path / "excerpt" / "labels"),))
        excerpt = pool.submit(plan._measure, tmp_path / "excerpt", "00", work).result()
    jobs = first_jobs(["00"], plan.Thesis.sizes.widths) + mask_control_jobs(sequence.root, ["00"])
    started = time.process_time()
    runner.run(jobs, sequence.root, tmp_path / "labels", tmp_path / "results")
    seconds = time.process_time() - started
    assert excerpt.jobs[plan.FIRST_SERIES] == len(jobs)
    cost = excerpt.series[plan.FIRST_SERIES]
    assert 1 / 3 < cost * (len(sequence) - 1) / seconds < 3
    assert 0 < excerpt.shared < cost and 200 < excerpt.row_bytes < 2000


@pytest.mark.parametrize("options, says", [
    (["--kitti", "nowhere"], "nowhere: holds no folder 'sequences'"),
])
def test_bad_input_is_one_clear_line(options, says, capsys):
    assert main(["plan", *options]) == 1
    error = capsys.readouterr().err.strip()
    assert error.startswith("error: ") and says in error and "\n" not in error


def test_a_damaged_frame_is_named_where_the_user_has_it(tiny_kitti, monkeypatch):
    monkeypatch.setattr(plan, "FRAMES", 3)
    path = tiny_kitti / "sequences/00/image_0/000002.png"
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match="kitti/sequences/00/image_0/000002.png: the image is truncated"):
        plan.calibrate(plan.Thesis(tiny_kitti, ("00",), repetitions=1))


def test_too_short_a_sequence_is_one_clear_line(tiny_kitti):
    with pytest.raises(InputError, match="too short to plan from; one of 6 frames"):
        plan.calibrate(plan.Thesis(tiny_kitti, ("00",), repetitions=1))
