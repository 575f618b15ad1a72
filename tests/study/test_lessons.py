"""What notebooks hand on: checked knobs, records that notice what was left out, and attempts."""

import numpy as np
import pandas as pd
import pytest

from thesis_repro.errors import InputError
from thesis_repro.study import lessons

NETWORK, TRAINING = "03_unet", "04_training"
LABELS, MASKS, ODOMETRY = "05_prediction", "06_keypoint_masks", "07_visual_odometry"


def run(build, notebook, needed, made, edited=None):
    lessons.finish(build, notebook, lessons.begin(build, notebook, *needed), made, edited)


@pytest.fixture
def chain(tmp_path):
    """Records of the notebooks 3 to 6, as if they had been run one after the other."""
    run(tmp_path, NETWORK, [], "network 1")
    run(tmp_path, TRAINING, [NETWORK], "weights 1", {"EPOCHS": 3})
    run(tmp_path, LABELS, [TRAINING], "label maps 1")
    run(tmp_path, MASKS, [LABELS], "masks 1", {"your mask": True})
    return tmp_path


def test_a_notebook_that_was_left_out_is_named(chain):
    run(chain, NETWORK, [], "network 2", {"DEPTH": 3})
    for needed in (TRAINING, LABELS, MASKS):  # the first one that is old, however far back
        with pytest.raises(InputError, match=f"training.json: .*run {TRAINING} again"):
            lessons.current(chain, needed)
    run(chain, TRAINING, [NETWORK], "weights 2")
    with pytest.raises(InputError, match=f"labels.json: .*run {LABELS} again"):
        lessons.current(chain, LABELS)
    run(chain, LABELS, [TRAINING], "label maps 2")
    with pytest.raises(InputError, match=f"masks.json: .*run {MASKS} again"):
        lessons.begin(chain, ODOMETRY, LABELS, MASKS)
    run(chain, MASKS, [LABELS], "masks 1")
    assert lessons.current(chain, MASKS)[MASKS].edited == {"03, DEPTH": 3}


def test_the_same_outcome_again_makes_nothing_old(chain):
    run(chain, NETWORK, [], "network 1")
    used = lessons.current(chain, LABELS, MASKS)
    assert used[LABELS].edited == {"04, EPOCHS": 3}
    assert lessons.name_of(used[MASKS].edited) == "04, EPOCHS=3; 06, your mask"


def test_a_notebook_that_did_not_end_counts_as_not_run(chain):
    lessons.begin(chain, TRAINING, NETWORK)
    with pytest.raises(InputError, match=f"run notebook {TRAINING} first"):
        lessons.current(chain, LABELS)


def test_paths_by_hand_are_those_of_the_masks_that_are_there(chain):
    assert lessons.of_odometry(chain).edited == {}
    run(chain, ODOMETRY, [MASKS], "paths 1", {"your loop": True})
    assert "07, your loop" in lessons.of_odometry(chain).edited
    run(chain, MASKS, [LABELS], "masks 2")
    with pytest.raises(InputError, match=f"run {ODOMETRY} again"):
        lessons.of_odometry(chain)


@pytest.mark.parametrize(
    "text",
    ["", "{", "[]", "{}", "3", '{"canny": [1, 3]}', '{"made": 1, "edited": []}', "\udcff"]
    + ['{"made": 1, "made_from": {"10_later": 1}}'],
)
def test_a_damaged_record_is_named(chain, text):
    (chain / "masks.json").write_bytes(text.encode("utf-8", "surrogateescape"))
    with pytest.raises(InputError, match=f"masks.json: is damaged; run {MASKS} again"):
        lessons.current(chain, MASKS)


@pytest.mark.parametrize("value", ["10", None, 2.5, 10.0, True, [10], 0, 101, 7])
def test_a_knob_that_is_no_whole_number_is_refused_as_it_was_given(value):
    lessons.whole("SIZE", np.int64(10), (1, 100, 2))
    with pytest.raises(InputError) as error:
        lessons.whole("SIZE", value, (1, 100, 2))
    assert str(error.value).startswith(f"SIZE={value!r}: ")


@pytest.mark.parametrize("value", ["0.1", None, 0, -1.0, np.nan, np.inf, True, [0.1]])
def test_a_knob_that_is_no_number_above_zero_is_refused(value):
    lessons.positive("RATE", np.float32(0.1))
    with pytest.raises(InputError) as error:
        lessons.positive("RATE", value)
    assert str(error.value).startswith(f"RATE={value!r}: ")


def test_a_knob_that_is_no_choice_is_refused():
    lessons.one_of("FRESH", True, (False, True))
    for value in ("True", None, [], {}):
        with pytest.raises(InputError, match="FRESH=.*: choose one of False, True"):
            lessons.one_of("FRESH", value, (False, True))


def test_names_of_sequences_are_a_list_of_known_ones():
    known = ["00", "01"]
    assert lessons.names_of(None, known) == known and lessons.names_of(("01",), known) == ["01"]
    for value in ("00", ["02"], [], 0, True, [0]):
        with pytest.raises(InputError, match="NAMES=.*there are 00, 01"):
            lessons.names_of(value, known)


SIZE = (4, 6)
EDGES = np.zeros(SIZE, np.uint8)
MASK = np.where(np.arange(24).reshape(SIZE) % 2, np.uint8(255), np.uint8(0))


def test_a_mask_of_booleans_counts_as_one_of_numbers():
    for made in ((EDGES, MASK), (EDGES > 0, MASK > 0), [EDGES, MASK]):
        edges, mask = lessons.edges_and_mask(made, SIZE)
        assert mask.dtype == np.uint8 and np.array_equal(mask, MASK) and not edges.any()


@pytest.mark.parametrize(
    "made, word",
    [
        (MASK, "one value"),
        (None, "one value"),
        ((EDGES, MASK, MASK), "two, edge image and mask"),
        ((EDGES, MASK / 255), "float64"),
        ((EDGES.astype(float), MASK), "edge image is float64"),
        ((EDGES, MASK[:2]), r"\(2, 6\)"),
        ((EDGES, 255), r"\(\)"),
        ((EDGES, None), "object"),
        ((EDGES, np.arange(24, dtype=np.uint8).reshape(SIZE)), "24 different values"),
        ((EDGES, MASK // 255), "0 and 255"),
    ],
)
def test_another_result_of_the_mask_function_is_named(made, word):
    with pytest.raises(InputError, match=f"mask_by_hand: .*{word}") as error:
        lessons.edges_and_mask(made, SIZE)
    assert "\n" not in str(error.value)


def attempt(name, inputs, factors, baseline=1.0):
    """Runs of two sequences and one repetition, whose errors with masks are these factors."""
    rows = []
    for sequence, factor in zip(("00", "01"), factors):
        for method, error in (("baseline", baseline), ("masked", 2.0 * factor)):
            errors = dict.fromkeys(lessons.ERRORS, error) | {"rotation": 0.5 * error}
            rows.append({"sequence": sequence, "method": method, "repetition": 0, **errors})
    facts = {"mean_keypoints": 100, "attempt": name, "inputs": inputs, "frames": 0, "mean_iou": 0.5}
    return pd.DataFrame(rows).assign(**facts)


def test_attempts_are_compared_with_the_first_one_by_the_errors_that_decide(tmp_path):
    file = tmp_path / "attempts.csv"
    first, spread = attempt("as the thesis's", "aaaa", (1, 1)), attempt("06, a", "bbbb", (0.5, 4))
    worse = attempt("07, b", "cccc", (2, 3), baseline=5.0)
    lessons.keep_attempts(file, [first])
    kept = lessons.keep_attempts(file, [attempt("as the thesis's", "aaaa", (9, 9)), spread, worse])
    pd.testing.assert_frame_equal(kept, lessons.keep_attempts(file, []), check_dtype=False)
    table = lessons.compare_attempts(kept)
    assert list(table["error"][:3]) == ["aligned ATE", "rotation error a frame", "RMSE"]
    by_error = table[table["error"] == "aligned ATE"].set_index("attempt")
    assert by_error["masks"].tolist() == [2, 4.5, 5]
    assert by_error["all keypoints"].tolist() == [1, 1, 5]
    assert np.allclose(by_error["ratio"], [1, 2**0.5, 6**0.5])
    assert by_error["lowest"].tolist() == [1, 0.5, 2]
    assert by_error["highest"].tolist() == [1, 4, 3]
    assert len(set(by_error["difference"])) == 3
    assert table.groupby("attempt")["difference"].nunique().eq(1).all()
    rotations = table[table["error"] == "rotation error a frame"]["masks"]
    assert rotations.tolist() == [1, 2.25, 2.5]


def test_a_file_of_attempts_of_another_version_is_begun_anew(tmp_path):
    file = tmp_path / "attempts.csv"
    file.write_text("sequence,attempt,rmse\n00,before,1.0\n")
    kept = lessons.keep_attempts(file, [attempt("06, a", "bbbb", (1, 2))])
    assert set(kept["attempt"]) == {"06, a"} == set(pd.read_csv(file)["attempt"])


def test_paths_of_an_edited_loop_are_read_back_or_named(tmp_path, tiny_kitti):
    from thesis_repro.data.kitti import Sequence

    drive = Sequence(tiny_kitti, "00")
    poses = np.tile(np.eye(4), (len(drive), 1, 1))
    lessons.keep_path(tmp_path, drive, "masked", 1, poses, 12.5)
    read, keypoints = lessons.path_of(tmp_path, drive, "masked", 1)
    assert np.array_equal(read, poses) and keypoints == 12.5
    assert len(lessons.path_of(tmp_path, drive.subset(2), "masked", 1)[0]) == 2
    lessons.keep_path(tmp_path, drive, "masked", 1, poses[:-1], 12.5)
    for seed in (0, 1):  # there is none, and a short one
        with pytest.raises(InputError, match=f"00-masked-{seed}.npz: .*{ODOMETRY} again"):
            lessons.path_of(tmp_path, drive, "masked", seed)


def test_names_and_digests_of_edits():
    assert lessons.name_of({}) == "as the thesis's"
    assert lessons.digest([1, {"a": 2, "b": 3}]) == lessons.digest([1, {"b": 3, "a": 2}])
    assert lessons.digest("one") != lessons.digest("two")
    assert lessons.changed({"a": 1, "b": 2}, {"a": 1, "b": 3}) == {"b": 2}
