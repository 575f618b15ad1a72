"""What a keypoint is worth: simulated scenes with a known truth, and the rule's verdicts."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
from street import Street

from keypoint_study import typical_worth, verdicts, worth, worth_check
from thesis_repro import Sequence
from thesis_repro.errors import InputError
from thesis_repro.odometry import OPENCV, THESIS

FOCAL, CENTRE, SIZE = 718.856, np.array([607.2, 185.2]), np.array([1241, 376])
NOISE = 0.05  # pixels, far below the threshold of an inlier, so that variances are proportional
FORWARD = np.array([0.0, 0.0, 1.0])  # the simulated motion; there is no rotation


def tracks(points, depths, noise):
    """Keypoints (N, 2) of a camera that moves forward by 1 m; noise: (N, 2), pixels."""
    rays = (points - CENTRE) / FOCAL
    moved = np.column_stack([rays, np.ones(len(rays))]) * depths[:, None] - FORWARD
    current = moved[:, :2] / moved[:, 2:] + noise / FOCAL
    return worth.Tracks(points, rays, current, np.ones(len(points), bool), THESIS.threshold)


def uniform(random, count):
    points = random.uniform((0, 60), SIZE, (count, 2))
    return points, np.exp(random.uniform(np.log(6), np.log(60), count))


def independent(random, noise=NOISE, count=200):
    points, depths = uniform(random, count)
    return tracks(points, depths, random.normal(0, noise, points.shape))


def copied(random, same=1.0):
    """100 keypoints and 100 neighbours within 6 pixels, whose noise is correlated by `same`."""
    points, depths = uniform(random, 100)
    noise, other = random.normal(0, NOISE, (2, 100, 2))
    noises = [noise, same * noise + np.sqrt(1 - same**2) * other]
    beside = points + random.uniform(-6, 6, points.shape) * (same < 1)
    both = np.concatenate([points, beside])
    return tracks(both, np.tile(depths, 2), np.concatenate(noises))


def crowded(random):
    """200 keypoints with independent noise in 20 crowds."""
    places, _ = uniform(random, 20)
    points = np.repeat(places, 10, axis=0) + random.normal(0, 12, (200, 2))
    _, depths = uniform(random, 200)
    return tracks(points, depths, random.normal(0, NOISE, points.shape))


def variances(make, scenes):
    """Variance of one keypoint (rotation, direction): by each split, and true, from the errors."""
    rows = []
    truth = type("Truth", (), {"rotation": np.eye(3), "translation": FORWARD})
    for scene in range(scenes):
        simulated = make(np.random.default_rng(scene))
        count = len(simulated.points)
        (error,) = worth._angles([(worth.refined_motion(simulated, np.arange(count)), truth)])
        row = dict(zip(("rotation_true", "direction_true"), np.square(error) * count, strict=True))
        for split in worth.SPLIT:
            (halves,) = worth._draws(simulated, count, split, [(0, scene)])
            row |= {f"{name}_{split}": halves[f"{name}_variance"] for name in worth.MOTIONS}
        rows.append(row)
    return pd.DataFrame(rows).median()


SCENES = {
    "independent": independent,
    "each twice": copied,
    "neighbours, correlation 0.8": lambda random: copied(random, 0.8),
    "20 crowds": crowded,
    "twice the noise": lambda random: independent(random, 2 * NOISE),
}


def worths_of(names, scenes):
    """The worths of simulated scenes, those of "independent" being 1; one column a kind."""
    table = pd.DataFrame({name: variances(SCENES[name], scenes) for name in names})
    return table.rdiv(table["independent"], axis=0)


@pytest.mark.slow
def test_copies_tell_nothing_which_only_fields_see_and_twice_the_noise_a_quarter():
    table = worths_of(["independent", "each twice", "twice the noise"], 250)
    assert table["twice the noise"].between(0.19, 0.32).all(), table
    twice = table["each twice"]
    for motion in worth.MOTIONS:
        assert twice[[f"{motion}_true", f"{motion}_fields"]].between(0.35, 0.65).all(), twice
        assert twice[f"{motion}_points"] > 0.8, twice


@pytest.mark.torture
def test_simulated_scenes(capsys):
    """The table in docs/reading-results.md."""
    table = worths_of(SCENES, 300)
    with capsys.disabled():
        print("\n" + table.T.round(2).to_string())
    assert (table.loc[["rotation_points", "direction_points"], "each twice"] > 0.8).all()


def worths(logarithms):
    """A table of `worth` with given logarithms of the worths, (streets, 4)."""
    rows = []
    for street, values in enumerate(np.exp(logarithms)):
        for split, numbers in zip(worth.SPLIT, values.reshape(2, 2), strict=True):
            row = {"sequence": str(street), "choice": "mine", "number": 400, "split": split}
            rows.append({**row, "keypoints": 400, **dict(zip(worth.MOTIONS, numbers, strict=True))})
    return pd.DataFrame(rows)


def test_verdicts_need_both_splits_and_both_motions():
    random = np.random.default_rng(0)
    near_one = random.normal(0, 0.03, (8, 4))

    def verdict(logarithms):
        (row,) = typical_worth.typical_worths(worths(logarithms)).itertuples()
        return row.verdict

    assert verdict(near_one) == verdicts.AS_MUCH
    assert verdict(near_one - 0.7) == verdicts.LESS
    assert verdict(near_one + 0.7) == verdicts.MORE
    for column in range(4):
        less_but_one = near_one - 0.7 * (np.arange(4) != column)
        assert verdict(less_but_one) == verdicts.NO_CLEAR_DIFFERENCE
    assert verdict(near_one[:5] - 0.7) == verdicts.TOO_FEW
    # the last two are new, and lie on the other side in one motion by fields
    more = np.concatenate([near_one + 0.7] * 3)
    more[-2:, 0] *= -0.1
    told = [typical_worth.typical_worths(worths(more), new) for new in ([], ["22"], ["22", "23"])]
    assert [each["verdict"][0] for each in told] == [
        verdicts.MORE,
        verdicts.MORE,
        verdicts.NO_CLEAR_DIFFERENCE,
    ]


def test_no_word_is_said_where_the_check_found_the_measure_wrong(monkeypatch):
    less = worths(np.random.default_rng(0).normal(-0.7, 0.03, (8, 4)))
    off = [1.4, 1.6, np.nan]
    monkeypatch.setattr(typical_worth, "factor_off", lambda *_: off[0])
    words = []
    while off:
        (row,) = typical_worth.typical_worths(less).itertuples()
        words.append(row.verdict)
        off.pop(0)
    assert words == [verdicts.LESS, verdicts.NOT_JUDGED, verdicts.LESS]


def test_the_true_worth_of_twice_the_noise_is_a_quarter(monkeypatch):
    """Simulated steps of 1 m straight ahead, in place of frames."""
    steps = 40
    poses = np.tile(np.eye(4), (steps + 1, 1, 1))
    poses[:, 2, 3] = np.arange(steps + 1)
    drive = SimpleNamespace(name="00", scales=np.ones(steps + 1), poses=poses)

    def tracked(_, index, chosen, *__):
        random = np.random.default_rng(index)
        noisy, few = independent(random, 2 * NOISE), independent(random)
        return independent(random), {("noisy", 200): noisy, ("few", 50): few}

    monkeypatch.setattr(worth, "tracked", tracked)
    # few ones are compared with more random ones, and each tells as much as one of those
    monkeypatch.setattr(worth, "MIN_RANDOM", 200)
    noisy, few = worth_check.true_worths(drive, {}, 1).itertuples()
    assert (noisy.choice, noisy.number, noisy.sequence) == ("noisy", 200, "00")
    assert 0.15 < noisy.rotation < 0.4 and 0.15 < noisy.direction < 0.4
    assert 0.6 < few.rotation < 1.6 and 0.6 < few.direction < 1.6


def test_the_factor_off_is_the_largest_and_that_of_a_ratio_is_a_ratio(monkeypatch):
    columns = [f"{name}_{kind}" for name in worth.MOTIONS for kind in ("true", *worth.SPLIT)]
    rows = {
        ("masks", 400): [0.5, 0.6, 0.4, 1.0, 1.0, 1.0],
        ("mirrored mask", 400): [0.5, 0.6, 0.4, 1.0, 1.5, 1.0],
    }
    table = pd.DataFrame.from_dict(rows, orient="index", columns=columns)
    table.index = pd.MultiIndex.from_tuples(rows)
    monkeypatch.setattr(worth_check, "checks", lambda: table)
    asked = ["masks", "mine: masks", "masks, over mirrored mask", "mirrored mask", "random lines"]
    found = [worth_check.factor_off(name, 400) for name in asked]
    assert found == pytest.approx([1.25, 1.25, 1.5, 1.5, np.nan], nan_ok=True)
    assert np.isnan(worth_check.factor_off("masks", 50))


@pytest.mark.parametrize("streets", [8, 11])
def test_error_rates_of_the_verdicts_by_chance(streets):
    """Streets that differ by 30 %; worths of one street are correlated by 0.5."""
    random = np.random.default_rng(0)

    def words(centre):
        spread = random.normal(0, 0.3 * np.sqrt(0.5), (200, streets, 1))
        spread = spread + random.normal(0, 0.3 * np.sqrt(0.5), (200, streets, 4))
        names = [f"{motion}_{split}" for split in worth.SPLIT for motion in worth.MOTIONS]
        studies = [pd.DataFrame(each + centre, columns=names) for each in spread]
        return [typical_worth._verdict(dict(of_study.items())) for of_study in studies]

    wrong = [each in (verdicts.LESS, verdicts.MORE) for each in words(0)]
    assert np.mean(wrong) < 0.03
    assert np.mean([each == verdicts.LESS for each in words(np.log(0.5))]) > 0.9
    assert np.mean([each == verdicts.AS_MUCH for each in words(np.log(1.25))]) < 0.05


def test_the_table_is_the_same_every_time_and_an_empty_mask_tells_nothing(monkeypatch):
    street = Street(3)
    choices = {
        ("random", 100): (THESIS, None),
        ("few", 0): (replace(THESIS, max_keypoints=60), None),
        ("none", 100): (THESIS, [np.zeros(street.size, np.uint8)] * len(street)),
    }
    table = worth.worth_of(street, choices)
    pd.testing.assert_frame_equal(table, worth.worth_of(street, choices))
    monkeypatch.setattr(worth, "SEED", 1)
    assert not table.equals(worth.worth_of(street, choices))
    table = table.set_index(["choice", "split"])
    assert (table["steps"] == 2).all()
    assert (table.loc["random", "keypoints"] == 100).all()
    assert (table.loc["few", "keypoints"] == 60).all()
    assert (table.loc["none", ["rotation_deg", "direction_deg"]] == worth.NO_MOTION).all(axis=None)
    assert (table.loc["none", ["rotation", "direction"]] < 0.1).all(axis=None)


def test_own_keypoints_are_found_and_tracked_by_their_own_functions():
    street = Street(3)
    calls = {"still": OPENCV._replace(track=lambda _, __, points, ___: (points, points[:, 0] > 0))}
    choices = {("still", 100): (THESIS, None), ("tracked", 100): (THESIS, None)}
    table = worth.worth_of(street, choices, calls=calls).set_index(["choice", "split"])
    assert (table.loc["still", "rotation_deg"] != table.loc["tracked", "rotation_deg"]).all()


def test_what_the_camera_did_not_see_has_no_keypoints(monkeypatch):
    street = Street(3)
    visible = np.zeros_like(street.frame(0))
    visible[:, : visible.shape[1] // 2] = 255
    choices = {("all", 0): (THESIS, None)}
    whole = worth.worth_of(street, choices)
    monkeypatch.setattr(street, "visible", lambda index: visible)
    half = worth.worth_of(street, choices)
    assert 0 < half["keypoints"].max() < 0.8 * whole["keypoints"].min()


def test_steps_without_lengths_are_all_kept_and_short_ones_are_not():
    street = Street(4)
    lengths = {(0, 1, 0.1, 0.1): 1, None: 3}  # steps that are kept
    for scales, kept in lengths.items():
        drive = Sequence.from_arrays(street.images, street.intrinsics, scales=scales)
        assert (worth.worth_of(drive, {("all", 0): (THESIS, None)})["steps"] == kept).all()
    drive = Sequence.from_arrays(street.images, street.intrinsics, scales=[0, 0.1, 0.1, 0.1])
    with pytest.raises(InputError):
        worth.worth_of(drive, {("all", 0): (THESIS, None)})


def test_one_choice_is_divided_by_another():
    rows = [
        (name, choice, 400, "fields", worth_of_choice, worth_of_choice / 2)
        for name in ("00", "01")
        for choice, worth_of_choice in (("masks", 0.5), ("beside", 2.0))
    ]
    columns = ["sequence", "choice", "number", "split", "rotation", "direction"]
    divided = typical_worth.over(pd.DataFrame(rows, columns=columns), "masks", "beside")
    assert list(divided["rotation"]) == list(divided["direction"]) == [0.25, 0.25]
    assert list(divided["sequence"]) == ["00", "01"] and divided["choice"].nunique() == 1


@pytest.mark.slow
def test_one_fit_sees_what_neighbours_share():
    """Its variance is that of the errors, also where a keypoint has a copy."""
    truth = type("Truth", (), {"rotation": np.eye(3), "translation": FORWARD})
    for make in (independent, copied):
        told, true = [], []
        for scene in range(60):
            simulated = make(np.random.default_rng(scene))
            every = np.arange(len(simulated.points))
            told.append(worth._one_fit(simulated, every))
            true += worth._angles([(worth.refined_motion(simulated, every), truth)])
        means = pd.DataFrame(told).mean() / len(every)
        squares = np.square(true).mean(axis=0)
        for name, square in zip(worth.MOTIONS, squares, strict=True):
            assert means[f"{name}_variance"] == pytest.approx(square, rel=0.6), (make, name)
