"""What became of the claims of the thesis: a word by its own tables, and one for the runs at hand.

The words are those of `claim_rule`; claims.json has each row's texts, and the digests of the
sentences that it stands for. Each function below tests rows of one kind on the tables at hand, and
raises NotAtHand if they lack what it needs. Errors are those of the thesis's estimator.
"""

import json
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import binom

from keypoint_study import comparisons, ratios, verdicts
from keypoint_study.best_width import of_chosen_width
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.path_errors import ERRORS
from keypoint_study.report import style, texts
from thesis import REPORTED, audit, claim_rule, tables
from thesis.claim_rule import MARGIN, NO_EVIDENCE, NOT_REPRODUCED, NOT_TESTED, REPRODUCED, UNDECIDED
from thesis.run_settings import ROOT
from thesis_repro.odometry import THESIS
from thesis_repro.running.files import write_text

ROWS = json.loads((Path(__file__).parent / "claims.json").read_text(encoding="utf-8"))
DECIDING = comparisons.JUDGING_METRICS
HUNDREDS, OTHER_HUNDREDS = 500, 999  # keypoints at most: the audit's limit, and a wider one
LIMIT = THESIS.max_keypoints
REDUCTION = REPORTED["headline_claims"]["keypoint_reduction_factor"]
SAVED = REPORTED["headline_claims"]["time_savings_percent"]
TABLE_4_1 = pd.DataFrame(REPORTED["table_4_1"]).set_index("sequence")
CHANGES = audit.CHANGES  # Tables 4.2 and 4.3
SHARP = 90  # degrees of turns in a sequence
MISSED = 1  # percent of its length, by which the end of a path misses the true one
RETURNS = 10  # percent of its length, at most, between both ends of a path that returns
HEAVILY = 0.5  # a number that is heavily reduced
LARGE_PORTIONS = 75  # percent of the sky that are found, if large portions are missed
LOST_HALF = 0.5  # of the runs over a sequence
EVIDENCE = "kitti_excerpts"  # the folder of the frames that the thesis's network was run on
CAMVID = "camvid/"  # tables of the thesis's network, trained on CamVid


class NotAtHand(Exception):
    """The tables lack what a claim needs."""


class Found(NamedTuple):
    """What a test gives. here: the numbers. network: those of the thesis's network."""

    word: str
    here: str
    network: str = ""


class Tables:
    """The tables that the claims are tested on.

    read: returns a table in figures by its name, or raises FileNotFoundError. folder: in figures,
    of a run on real frames.
    """

    def __init__(self, read: Callable[[str], pd.DataFrame], folder: str) -> None:
        self.read, self.folder = read, folder

    def table(self, name: str) -> pd.DataFrame:
        """Return a table of the run."""
        try:
            return self.read(f"{self.folder}/{name}")
        except FileNotFoundError:
            raise NotAtHand(name) from None

    def rows(self, table: str, method: str, estimator: str = "thesis") -> pd.DataFrame:
        """Return the runs of a method in a table.

        method: "masked" has the tested width, "every width" all, and "best width" of each
        repetition the best one, as the thesis chooses it; in few_keypoints_runs "spread 200".
        """
        runs = self.table(table)
        if "choice" in runs:
            runs = runs.assign(method=runs["choice"] + " " + runs["number"].astype(str))
        is_masked = method in ("masked", "every width", "best width")
        rows = runs[runs["method"] == ("masked" if is_masked else method)]
        rows = rows[rows["estimator"] == estimator]
        if method == "masked" and table == "runs":
            rows = rows[rows["dilation_width"] == self.width]
        if method in ("every width", "best width"):  # of repetitions that have all widths
            counts = rows.groupby("repetition")["dilation_width"].nunique()
            rows = rows[rows["repetition"].map(counts) == counts.max()]
        if method == "best width":
            rows = pd.concat([of_chosen_width(of_one) for _, of_one in rows.groupby("repetition")])
        if rows.empty:
            raise NotAtHand(method)
        return rows

    @property
    def width(self) -> int:
        """The width of masks that was fixed before any run."""
        return comparisons.tested_width(self.table("runs")) or CONTROL_WIDTH

    def over(self, table: str, method: str, other: str, error: str, by: str = "thesis") -> Any:
        """Return the ratios of an error to that of another method, by sequence. by: estimator."""
        rows, reference = self.rows(table, method, by), self.rows(table, other, by)
        of_sequences = ratios.ratios_of(rows, reference, error)
        if of_sequences.empty:
            raise NotAtHand(error)
        return of_sequences

    def measured(self, row: str, key: str, **more: str) -> dict[str, Any]:
        """Return value, low, high and n of a measurement of the audit, by its key in audit.json."""
        named = {"row": row, "quantity": audit.MEASURED[row][key]} | more
        rows = self.table("audit")
        found = rows[(rows[list(named)] == pd.Series(named)).all(axis=1)].to_dict("records")
        if not found:
            raise NotAtHand(key)
        return found[0]

    def of_network(self, name: str) -> pd.DataFrame:
        """Return a table of the thesis's network, trained on CamVid."""
        try:
            return self.read(f"{CAMVID}{name}")
        except FileNotFoundError:
            raise NotAtHand(name) from None


def shown(of_sequences: pd.Series) -> str:
    """Return a typical ratio as text: "0.95 (0.56-0.99) ↓"."""
    return texts.short(ratios.typical_ratio(of_sequences))


def failing(runs: pd.DataFrame) -> pd.Series:
    """Return for each sequence whether half of its runs or more fail."""
    return ratios.has_failed(runs).groupby(runs["sequence"]).mean() >= LOST_HALF


# The thesis's procedure: the best of all widths


@cache
def procedure(at_hand: Tables, metric: str) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the changes (%) that the thesis's procedure finds, and those if masks do nothing.

    The first has a column for each repetition, a row a sequence; the second a row for each
    simulated study, a column a sequence.
    """
    masked, every = at_hand.rows("runs", "every width"), at_hand.rows("runs", "baseline")
    shuffled = at_hand.table("shuffled_runs")
    found = {
        repetition: tables.changes_of_repetition(masked, every, metric, repetition)
        for repetition in sorted(masked["repetition"].unique())
    }
    widths = masked["dilation_width"].nunique()
    return pd.DataFrame(found), tables.null_distribution(shuffled, widths, metric)


def aggregate(at_hand: Tables, metric: str) -> Found:
    """A sum, or mean, of percentages."""
    found, studies = procedure(at_hand, metric)
    means, by_chance = found.mean(), studies.mean(axis=1)
    low, high = tables.middle(by_chance)
    fixed = at_hand.over("runs", "masked", "baseline", metric)
    chosen = of_chosen_width(at_hand.rows("runs", "every width"))
    together = tables.changes(chosen, at_hand.rows("runs", "baseline"), metric)
    theirs = CHANGES[metric.upper()].mean()
    needed = claim_rule.needed(fixed, 1 + theirs / 100)
    return Found(
        claim_rule.against_chance(means.median(), by_chance),
        f"Means of the repetitions: {_listed(means)} % (sums {_listed(found.sum(), '.0f')}; of their mean "
        f"errors {together.sum():.0f}). If masks did "
        f"nothing: {by_chance.mean():.1f} ({low:.1f} to {high:.1f}). Width {at_hand.width}, fixed "
        f"before: {shown(fixed)} times the error of all; {theirs:.2f} % would need {needed} sequences.",
    )


def improved(at_hand: Tables, least: Callable[[int], float]) -> Found:
    """Errors fall on some of the sequences. least: how many of n."""
    words, told = [], []
    for metric in ("rmse", "mae"):
        found, studies = procedure(at_hand, metric)
        counts, by_chance = (found < 0).sum(), (studies < 0).sum(axis=1)
        word = claim_rule.against_chance(-counts.median(), -by_chance)
        words.append(word if counts.median() >= least(len(found)) else NOT_REPRODUCED)
        told.append(f"{metric.upper()} lower on {_listed(counts, '.0f')} of {len(found)}")
        told.append(f"{by_chance.mean():.1f} if masks did nothing")
    return Found(claim_rule.agreed(words), "; ".join(told) + ".")


def named(at_hand: Tables, names: Iterable[str], metrics: Iterable[str], side: int = -1) -> Found:
    """Errors are lower (side -1) or higher on named sequences, by the median of the repetitions.

    One at hand on which they are not shows the opposite.
    """
    told, holds, beyond = [], [], []
    found, studies = procedure(at_hand, "rmse")
    at_both = [name for name in names if name in found.index and name in studies]
    for metric in metrics:
        found, studies = procedure(at_hand, metric)
        typical = found.median(axis=1)[at_both]
        low, high = studies[at_both].quantile(0.025), studies[at_both].quantile(0.975)
        holds += list(typical * side > 0)
        beyond += list(typical < low) if side < 0 else list(typical > high)
        each = ", ".join(f"{name} {value:+.1f}" for name, value in typical.items())
        told.append(f"{metric.upper()} {each} %")
    missing = set(names) - set(at_both)
    if not all(holds):
        word = NOT_REPRODUCED
    elif missing:
        raise NotAtHand(missing)
    else:
        word = REPRODUCED if all(beyond) else NO_EVIDENCE
    return Found(word, f"Best width, median of the repetitions: {'; '.join(told)}.")


def best_widths(at_hand: Tables) -> Found:
    """Widths of 9 to 11 have the lowest error for most sequences."""
    best, masked = at_hand.rows("runs", "best width"), at_hand.rows("runs", "every width")
    one = best.drop_duplicates(["sequence", "repetition"])
    counts = one["dilation_width"].isin(audit.WIDTHS).groupby(one["repetition"]).sum()
    n, widths = best["sequence"].nunique(), masked["dilation_width"].unique()
    share = np.isin(widths, audit.WIDTHS).mean()
    chance = binom.ppf((1 + verdicts.LEVEL / 100) / 2, n, share)
    is_more = counts.median() > chance
    word = REPRODUCED if is_more else NO_EVIDENCE
    is_in = masked["dilation_width"].isin(audit.WIDTHS)
    over_others = ratios.ratios_of(masked[is_in], masked[~is_in], "rmse")
    return Found(
        word if counts.median() > n / 2 else NOT_REPRODUCED,
        f"On {_listed(counts, '.0f')} of {n}; on {n * share:.1f} if masks did nothing. The RMSE of these "
        f"widths is {shown(over_others)} times that of the others.",
    )


def _listed(numbers: pd.Series, digits: str = ".1f") -> str:
    return ", ".join(f"{number:{digits}}" for number in numbers)


# Both errors that decide


MARGINS = {name: error.margin for name, error in ERRORS.items() if error.decides}
MARGINS |= {"in_turns": ERRORS["rotation"].margin, "rmse": MARGIN}
CALLED = {"se3": "aligned ATE", "rotation": "rotation", "in_turns": "rotation in turns"}


def judged(side: int, errors: list[claim_rule.Error], here: str) -> Found:
    """Return the word on ratios that are said to be lower (side -1), higher (1) or no larger (0).

    here: what stands in the cell. Where nothing is decided, it says what would have been.
    """
    word = claim_rule.on_side(side, *errors) if side else claim_rule.as_good(*errors)
    if word == UNDECIDED:
        here = here.removesuffix(".") + "." + _not_seen(errors, side or -1)
        if not side:
            needed = [claim_rule.needed(each, 1 / margin, 90) for each, margin in errors]
            here += f" That they are no larger: {' and '.join(needed)}."
    return Found(word, here)


def compared(
    at_hand: Tables,
    side: int,
    table: str,
    method: str,
    other: str = "baseline",
    errors: Iterable[str] = tuple(DECIDING),
    beside: tuple[str, str, str] | None = None,
) -> Found:
    """A claim on errors with a method, over those with another one, as `judged` takes it.

    beside: another pair, which stands beside, and what it is.
    """
    measured = [(at_hand.over(table, method, other, error), MARGINS[error]) for error in errors]
    here = _told(at_hand, table, method, other, errors)
    if beside:
        here += f" {beside[2]}: {_told(at_hand, table, *beside[:2], errors)}"
    return judged(side, measured, here)


def _told(at_hand: Tables, table: str, method: str, other: str, errors: Iterable[str]) -> str:
    """Return the ratios of errors as text, and of the RMSE, and by both estimators."""
    told = []
    for estimator, title in (("thesis", ""), ("refined", "refined estimator: ")):
        try:
            each = [
                f"{CALLED[error]} {shown(at_hand.over(table, method, other, error, estimator))}"
                for error in errors
            ]
        except NotAtHand:
            continue
        told.append(title + ", ".join(each))
    if "rmse" in at_hand.table(table):
        told.insert(1, f"RMSE {shown(at_hand.over(table, method, other, 'rmse'))}")
    return "; ".join(told) + "."


def _not_seen(errors: list[claim_rule.Error], side: int) -> str:
    """Return what these sequences would have shown, and how many would be needed."""
    n = len(errors[0][0])
    if n < verdicts.MIN_SEQUENCES:
        return f" {n} sequences decide nothing; {verdicts.MIN_SEQUENCES} are needed."
    seen = [f"{claim_rule.seen(each, side):.2f}" for each, _ in errors]
    factors = [f"{margin**side:.2f}" for _, margin in errors]
    needed = [claim_rule.needed(each, margin**side) for each, margin in errors]
    return (
        f" These {n} would have shown {' and '.join(seen)}; for {' and '.join(factors)}, "
        f"{' and '.join(needed)} sequences."
    )


def as_well(at_hand: Tables) -> Found:
    """Masks do as well as all keypoints, at the width that was fixed before any run."""
    found = compared(at_hand, 0, "runs", "masked")
    best = at_hand.over("runs", "best width", "baseline", "rmse")
    runs, every = at_hand.rows("runs", "best width"), at_hand.rows("runs", "baseline")
    once = ratios.ratios_of(runs.query("repetition == 0"), every.query("repetition == 0"), "rmse")
    shuffles = ratios.range_of_shuffles(every)["factor"]
    fixed = at_hand.over("runs", "masked", "baseline", "rmse")
    ends = [claim_rule.seen(fixed, side) for side in (-1, 1)]
    here = (
        f"Width {at_hand.width}: {found.here} Of the RMSE, a fall would have been shown from "
        f"{ends[0]:.2f} on, a rise from {ends[1]:.2f} on. By its procedure, RMSE {shown(once)} in the "
        f"first repetition, {shown(best)} in all. Shuffling the points alone changes the RMSE by a "
        f"factor of {shuffles.median():.2f}, at most {shuffles.max():.2f}."
    )
    if at_hand.folder != EVIDENCE:
        return Found(found.word, here)
    told = [
        f"{row['estimator']}: aligned ATE {row['aligned ATE']}, rotation "
        f"{row['rotational RPE, 1 frame']}; RMSE {row['RMSE']}: {row['verdict']}."
        for _, row in at_hand.of_network("streets").iterrows()
    ]
    return Found(found.word, here, " ".join(told))


# The number of keypoints


def wider(at_hand: Tables) -> Found:
    """Wider masks keep more keypoints in every sequence."""
    masked = at_hand.rows("runs", "every width")
    kept = masked.groupby(["sequence", "dilation_width"])["mean_keypoints"].mean().unstack()
    rising = kept.diff(axis=1).iloc[:, 1:].gt(0).all(axis=1)
    word = REPRODUCED if rising.all() else NOT_REPRODUCED
    return Found(word, f"On {rising.sum()} of {len(rising)}.")


def fewer(at_hand: Tables) -> Found:
    """Masks of the best width leave 3 to 5 times fewer keypoints."""
    factor = ratios.typical_ratio(LIMIT / _kept(at_hand))
    here = f"Best widths: {texts.short(factor).rstrip(' ↑↓')} times fewer than {LIMIT}."
    fixed = [at_hand.rows("runs", name)["mean_keypoints"].mean() for name in ("baseline", "masked")]
    here += f" Width {at_hand.width}: {fixed[0]:.0f} to {fixed[1]:.0f}."
    word = claim_rule.in_range(factor["ratio"], factor["low"], factor["high"], *REDUCTION)
    if word == UNDECIDED:
        here += _not_told(factor["ratio"], factor["low"], factor["high"], REDUCTION, factor["n"])
    return Found(word, here)


def _not_told(value: float, low: float, high: float, said: list[float], n: int) -> str:
    """Return how many sequences would decide on a range, if they differ as these n do."""
    least, most = said
    wide = least / MARGIN, most * MARGIN
    room = max(wide[0] - value, value - wide[1])  # of a number outside
    if least <= value <= most:
        room = min(value - wide[0], wide[1] - value)
    if room <= 0:
        return " It lies beside the range, but about: no number of sequences decides this."
    reach = max(value - low, high - value)
    return f" {n * (reach / room) ** 2:.0f} such sequences would decide it."


def hundreds(at_hand: Tables) -> Found:
    """Masks of the best width leave a few hundred keypoints."""
    kept = _kept(at_hand)
    low, high = ratios.mean_interval(kept)
    words = [claim_rule.at_most(low, high, limit) for limit in (HUNDREDS, OTHER_HUNDREDS)]
    return Found(
        words[0],
        f"Best widths: {kept.mean():.0f} ({low:.0f}-{high:.0f}); a few hundred are at most {HUNDREDS} "
        f"here, as in the audit. Were they {OTHER_HUNDREDS}: {words[1]}.",
    )


def _kept(at_hand: Tables) -> pd.Series:
    return at_hand.rows("runs", "best width").groupby("sequence")["mean_keypoints"].mean()


def outlines(at_hand: Tables) -> Found:
    """On outlines alone, there are far fewer keypoints: half or less."""
    masked = at_hand.rows("runs", "every width")
    narrowest = masked[masked["dilation_width"] == masked["dilation_width"].min()]
    kept = ratios.ratios_of(narrowest, at_hand.rows("runs", "baseline"), "mean_keypoints")
    typical = ratios.typical_ratio(kept)
    word = claim_rule.at_most(typical["low"], typical["high"], HEAVILY)
    fixed = at_hand.over("runs", "masked", "baseline", "mean_keypoints")
    here = f"The narrowest masks keep {shown(kept)} of all, width {at_hand.width} {shown(fixed)}."
    return Found(word, here)


def lost(at_hand: Tables) -> pd.Series:
    """Return the share (%) of keypoints that the next frame does not find, by choice, sequence."""
    table = at_hand.table("found_again")
    counts = table.groupby(["choice", "sequence"])[["lost", "detected"]].sum()
    return 100 * counts["lost"] / counts["detected"]


def other_each_time(at_hand: Tables) -> Found:
    """Keypoints are not the same from frame to frame."""
    shares = lost(at_hand)["all"]
    here = f"{shares.min():.0f} to {shares.max():.0f} % are not found in the next frame."
    return Found(REPRODUCED if (shares > 0).all() else NOT_REPRODUCED, here)


def found_again(at_hand: Tables) -> Found:
    """Keypoints on masks are found again more often than as many others."""
    shares = lost(at_hand)
    ends = {
        name: f"{of_one.min():.0f} to {of_one.max():.0f} %"
        for name, of_one in shares.groupby(level=0)
    }
    of_sequences = shares["mask"] / shares["strongest"]
    here = (
        f"Not found in the next frame: {ends['mask']} on masks, {ends['all']} of all; over as many of "
        f"the strongest {shown(of_sequences)}, over all {shown(shares['mask'] / shares['all'])}."
    )
    return judged(-1, [(of_sequences, MARGIN)], here)


def tenth_lost(at_hand: Tables) -> Found:
    """Without a tenth of the keypoints, the position can be lost."""
    without, every = (failing(at_hand.rows("ablations", name)) for name in ("dropout", "baseline"))
    word, n = claim_rule.can_happen(without.sum(), every.sum()), len(without)
    here = f"Without a random tenth, {without.sum()} of {n} sequences fail, with all {every.sum()}."
    if word == UNDECIDED:
        share, rare = (100 * (1 - 0.2 ** (1 / n)), np.log(0.2) / np.log(0.95))
        here += f" These {n} would have shown a loss on {share:.0f} % of sequences; for 5 %, {rare:.0f}."
    return Found(word, here)


# Time


def of_widths(at_hand: Tables) -> dict[int, pd.DataFrame]:
    """Return the time with masks over that with all keypoints, by threads: a column a width."""
    seconds = at_hand.table("timings/seconds").fillna({"dilation_width": 0})
    times = seconds.pivot(index=["threads", "sequence"], columns="dilation_width", values="seconds")
    over_all = times.drop(columns=0).div(times[0], axis=0)
    return {threads: rows.droplevel(0) for threads, rows in over_all.groupby(level=0)}


def on_each(at_hand: Tables, judge: Callable[[pd.DataFrame], Found]) -> Found:
    """A claim on times, on one thread and on all. judge: of times over those of all keypoints."""
    judged_on = {threads: judge(over_all) for threads, over_all in of_widths(at_hand).items()}
    told = [f"threads {n}: {found.here} ({found.word})" for n, found in judged_on.items()]
    return Found(claim_rule.agreed([found.word for found in judged_on.values()]), "; ".join(told))


def saved(over_all: pd.DataFrame) -> Found:
    """Widths of 9 to 11 save 5 to 10 % of the time."""
    typical = ratios.typical_ratio(_at_best(over_all))
    value, high, low = (100 * (1 - typical[name]) for name in ("ratio", "low", "high"))
    word = claim_rule.in_range(value, low, high, *SAVED)
    more = _not_told(value, low, high, SAVED, typical["n"]) if word == UNDECIDED else ""
    return Found(word, f"{value:.0f} % ({low:.0f} to {high:.0f}).{more}")


def saves(over_all: pd.DataFrame) -> Found:
    """Masks save time."""
    of_sequences = _at_best(over_all)
    return judged(-1, [(of_sequences, MARGIN)], shown(of_sequences))


def narrow_saves(over_all: pd.DataFrame) -> Found:
    """The narrowest masks take less time than the widest."""
    of_sequences = over_all[over_all.columns.min()] / over_all[over_all.columns.max()]
    return judged(-1, [(of_sequences, MARGIN)], shown(of_sequences))


def _at_best(over_all: pd.DataFrame) -> pd.Series:
    return over_all[[width for width in audit.WIDTHS if width in over_all]].mean(axis=1)


def slow_device(at_hand: Tables) -> Found:
    """With less processing power, masks save more: one thread against all."""
    over_all = of_widths(at_hand)
    if len(over_all) < 2:
        raise NotAtHand("threads")
    of_sequences = _at_best(over_all[min(over_all)]) / _at_best(over_all[max(over_all)])
    what = f"What is left of the time on one thread, over that on {max(over_all)}"
    return judged(-1, [(of_sequences, MARGIN)], f"{what}: {shown(of_sequences)}.")


# Causes


def on_01(at_hand: Tables) -> Found:
    """On 01, the path with all keypoints leaves the true one."""
    runs = [at_hand.rows("runs", "baseline", name) for name in ("thesis", "refined")]
    here = [ratios.count_failed(each[each["sequence"] == "01"]) for each in runs]
    holds = _failing_on(at_hand, "runs", "baseline", "01")
    word = REPRODUCED if holds else NOT_REPRODUCED
    return Found(word, f"{here[0]} runs fail; with the refined estimator {here[1]}.")


def _failing_on(at_hand: Tables, table: str, method: str, name: str, by: str = "thesis") -> bool:
    """Return whether half of the runs over one sequence or more fail."""
    fails = failing(at_hand.rows(table, method, by))
    if name not in fails:
        raise NotAtHand(name)
    return bool(fails[name])


def cause_on_01(at_hand: Tables) -> Found:
    """Few features and moving cars make it leave: both are needed."""
    if not _failing_on(at_hand, "runs", "baseline", "01"):
        raise NotAtHand("a run that fails")
    still = _failing_on(at_hand, "runs", "static", "01")
    kept = at_hand.rows("runs", "baseline").groupby("sequence")["mean_keypoints"].mean()
    fewest = kept.drop("01").min()
    inliers = at_hand.rows("ablations", "baseline", "inliers").query("sequence == '01'")
    static = at_hand.rows("runs", "static").query("sequence == '01'")
    return Found(
        NOT_REPRODUCED if still or kept["01"] >= fewest else REPRODUCED,
        f"Without keypoints on what can move, {ratios.count_failed(static)} runs fail. 01 has "
        f"{kept['01']:.0f} keypoints, the others {fewest:.0f} or more. If only RANSAC's inliers vote, "
        f"{ratios.count_failed(inliers)} fail.",
    )


def sharp_turns(at_hand: Tables, names: Iterable[str]) -> Found:
    """Localization is lost after a sharp turn on named sequences."""
    turned = at_hand.table("streets").set_index("sequence")["turns (degrees)"]
    fails, masked = (failing(at_hand.rows("runs", name)) for name in ("baseline", "masked"))
    turned = turned[(turned >= SHARP) & turned.index.isin(fails.index)]
    holds = {name: bool(fails[name]) for name in names if name in turned.index}
    if not holds:
        raise NotAtHand("turns")
    degrees = ", ".join(f"{name} ({turned[name]:.0f})" for name in turned.index)
    of_masks = ", ".join(name for name in turned.index if masked[name]) or "none"
    of_all = ", ".join(name for name in turned.index if fails[name]) or "none"
    return Found(
        claim_rule.in_all(list(holds.values())),
        f"Turns of {SHARP} degrees or more: {degrees}. Of these, {of_all} fail with all keypoints, "
        f"{of_masks} with masks.",
    )


def returns(at_hand: Tables, names: Iterable[str]) -> Found:
    """Paths do not return to their start on named sequences."""
    ends = at_hand.table("ends").set_index("sequence")
    ends = ends[(100 * ends["between ends"] < RETURNS * ends["metres"]) & ends.index.isin(names)]
    if ends.empty:
        raise NotAtHand("a path that returns")
    missed = (100 * ends["missed"] / ends["metres"]).groupby(level=0).median()
    told = ", ".join(f"{name} {value:.1f}" for name, value in missed.items())
    word = claim_rule.in_all(list(missed > MISSED))
    return Found(word, f"Percent of its length by which the end is missed: {told}.")


def thin_things(at_hand: Tables) -> Found:
    """Low thresholds are needed to find poles and signs."""
    low, high = (at_hand.measured("87", f"thin {name}") for name in ("5/15", "20/60"))
    here = f"{low['value']:.0f} % of their boundary pixels have an edge; with 20 and 60, {high['value']:.0f} %."
    return Found(claim_rule.apart(high, low), here)


def longer(at_hand: Tables) -> Found:
    """Errors grow with the number of frames."""
    runs = at_hand.rows("runs", "baseline")
    means = runs.groupby("sequence")[["rmse", "frames"]].mean()
    if means["frames"].nunique() == 1:
        raise NotAtHand("lengths")
    rank = means.corr("spearman").iloc[0, 1]
    word = claim_rule.grows(means["rmse"], means["frames"])
    here = f"Rank correlation of RMSE and frames: {rank:.2f} on {len(means)} sequences."
    if word == UNDECIDED:
        reach = (1.96 + 0.84) / np.sqrt(max(len(means) - 3, 1))
        needed = ((1.96 + 0.84) / np.arctanh(0.5)) ** 2 + 3
        here += f" These would have shown {np.tanh(reach):.2f}; for 0.5, {needed:.0f} sequences."
    return Found(word, here)


# The network


def scores(at_hand: Tables) -> Found:
    """IoU and F1 of the last epoch. Only Cityscapes, which the thesis trained on, can tell."""
    last = at_hand.table("figure_4_01").iloc[-1]
    told, holds = [], []
    for part, prefix in (("train", ""), ("validation", "val_")):
        for key, column in (("iou", "iou_score"), ("f1", "f1-score")):
            value, reported = last[prefix + column], REPORTED["segmentation_results"][part][key]
            told.append(f"{part} {key} {value:.2f} ({reported})")
            holds.append(1 / MARGIN < value / reported < MARGIN)
    return Found(claim_rule.in_all(holds), f"{len(last)} epochs; {', '.join(told)}.")


def in_scores(at_hand: Tables, measures: Iterable[str], domain: str) -> pd.DataFrame:
    """Return some scores of each training of the thesis's network on images of a domain."""
    table = at_hand.of_network("scores").set_index("measure")
    columns = [name for name in table if domain in name]
    return table.loc[list(measures), columns].set_axis(range(len(columns)), axis=1)


def large_and_small(at_hand: Tables) -> Found:
    """The network does well on large things, by the thesis's own limit, not on small ones."""
    large, small = (in_scores(at_hand, names, "CamVid").mean() for names in (LARGE, SMALL))
    holds = (large > GOOD_IOU) & (small < GOOD_IOU)
    here = of_areas(at_hand, "small", "large").here
    return Found(
        claim_rule.in_all(holds), here, f"IoU {_listed(large, '.2f')}; {_listed(small, '.2f')}."
    )


def of_areas(at_hand: Tables, worse: str, better: str) -> Found:
    """A measure is lower in one part of images than in another, of the package's network."""
    table = at_hand.of_network("areas").set_index("measure")
    first, second = table.loc[worse], table.loc[better]
    ends = [
        f"{row['mean (%)']:.0f} % ({row['low']:.0f}-{row['high']:.0f})" for row in (first, second)
    ]
    return Found(
        claim_rule.apart(first, second),
        f"{ends[0]} and {ends[1]}, {first['images']}, the package's network.",
    )


def sky(at_hand: Tables) -> Found:
    """On KITTI, large portions of the sky are missed."""
    found = in_scores(at_hand, ["sky found (%)"], "KITTI").iloc[0]
    word = claim_rule.in_all(list(found < LARGE_PORTIONS))
    return Found(word, SEEN, f"{_listed(found, '.0f')} % are found on KITTI's street scenes.")


def worse_on_kitti(at_hand: Tables, slightly: bool) -> Found:
    """The network is (slightly) worse on KITTI than on images as those that it was trained on."""
    own, kitti = (
        in_scores(at_hand, ["pixel accuracy"], each).iloc[0] for each in ("CamVid", "KITTI")
    )
    holds = own / kitti > 1
    if slightly:
        holds &= own / kitti < MARGIN
    here = f"Right pixels: {_listed(own, '.2f')} on CamVid, {_listed(kitti, '.2f')} on KITTI."
    return Found(claim_rule.in_all(list(holds)), SEEN, here)


def pixels(at_hand: Tables, column: str, least: float, most: float) -> Found:
    """A share of the pixels of label maps, in each set at hand."""
    table = at_hand.of_network("pixels")
    words = [claim_rule.in_range(value, value, value, least, most) for value in table[column]]
    unit = " %" if "%" in column else ""
    told = [
        f"{value:.3g}{unit} in {name}" for name, value in zip(table["label maps"], table[column])
    ]
    return Found(claim_rule.agreed(words), f"{', '.join(told)}.")


# The table

LARGE = [f"IoU: {name}" for name in ("road", "sidewalk", "building", "vegetation", "sky")]
SMALL = [f"IoU: {name}" for name in ("pole", "traffic sign", "person")]
SEEN = "Not measured: the package's network has seen these scenes."
GOOD_IOU = 0.5  # Section 4.1
EXTREMELY_WELL, BY_THE_LOOK = ("00", "01", "02", "08", "10"), ("01", "06", "10")
BOTH = ("rmse", "mae")
LOST_IN_TURNS = ("00", "06", "07")
BEST_NUMBER = "As many as the best widths leave"
TESTS: dict[str, Callable[[Tables], Found]] = {
    "aggregate rmse": partial(aggregate, metric="rmse"),
    "aggregate mae": partial(aggregate, metric="mae"),
    "all but three": partial(improved, least=lambda n: n - 3),
    "more than half": partial(improved, least=lambda n: n / 2),
    "as well": as_well,
    "extremely well": partial(named, names=EXTREMELY_WELL, metrics=BOTH),
    "by the look": partial(named, names=BY_THE_LOOK, metrics=BOTH),
    "05 higher": partial(named, names=("05",), metrics=BOTH, side=1),
    "04 higher": partial(named, names=("04",), metrics=("mae",), side=1),
    "widths": best_widths,
    "wider": wider,
    "fewer": fewer,
    "a few hundred": hundreds,
    "outlines": outlines,
    "plainly reduced": partial(
        compared, side=1, table="runs", method="fewer", beside=("reduced", "baseline", BEST_NUMBER)
    ),
    "reduced, over masks": partial(
        compared,
        side=1,
        table="runs",
        method="fewer",
        other="masked",
        beside=("reduced", "best width", BEST_NUMBER),
    ),
    "more keypoints": partial(
        compared, side=-1, table="few_keypoints_runs", method="random 800", other="all 0"
    ),
    "dense points": partial(
        compared, side=0, table="few_keypoints_runs", method="random 800", other="all 0"
    ),
    "frame to frame": other_each_time,
    "a tenth lost": tenth_lost,
    "time": partial(on_each, judge=saved),
    "fewer save time": partial(on_each, judge=saves),
    "narrow masks": partial(on_each, judge=narrow_saves),
    "edge device": slow_device,
    "sequence 01": on_01,
    "cause on 01": cause_on_01,
    "sharp turns": partial(sharp_turns, names=LOST_IN_TURNS),
    "returns": partial(returns, names=LOST_IN_TURNS),
    "turns": partial(compared, side=1, table="runs", method="masked", errors=("in_turns",)),
    "changing boundaries": partial(
        compared,
        side=1,
        table="ablations",
        method="jumping",
        other="held",
        beside=("jumping", "masked", "Over the usual masks"),
    ),
    "thin things": thin_things,
    "artefacts": partial(of_areas, worse="invented 20/60", better="invented 5/15"),
    "found again": found_again,
    "longer": longer,
    "scores": scores,
    "large and small": large_and_small,
    "edges of the frame": partial(of_areas, worse="rim", better="inside"),
    "sky": sky,
    "shadows": partial(of_areas, worse="dark", better="lit"),
    "slightly worse": partial(worse_on_kitti, slightly=True),
    "less accurate": partial(worse_on_kitti, slightly=False),
    "background": partial(pixels, column="pixels without a class (%)", least=80, most=90),
    "persons": partial(pixels, column="persons over road", least=0.75, most=0.75),
    "ORB": partial(compared, side=-1, table="ablations", method="orb"),
    "far": partial(compared, side=-1, table="ablations", method="parallax-3"),
    "near": partial(compared, side=-1, table="ablations", method="parallax-20"),
    "side of the turn": partial(
        compared, side=-1, table="ablations", method="turned-into", errors=("in_turns",)
    ),
    "vegetation": partial(compared, side=-1, table="ablations", method="no-vegetation"),
    "static things": partial(compared, side=-1, table="runs", method="static"),
}


def by_its_own_tables() -> dict[str, tuple[bool, str]]:
    """Return for rows that Tables 4.1 to 4.3 tell: whether they agree, and their numbers."""
    lower, n, means = (CHANGES < 0).sum(), len(CHANGES), CHANGES.mean()
    well, look = CHANGES.loc[list(EXTREMELY_WELL)], CHANGES.loc[list(BY_THE_LOOK)]
    over_all = [(1 + CHANGES[metric] / 100, MARGIN) for metric in CHANGES]
    kept = TABLE_4_1["mean_keypoints"]
    counts = f"RMSE on {lower['RMSE']}, MAE on {lower['MAE']} of {n}"
    best = int(TABLE_4_1["dilation_width"].isin(audit.WIDTHS).sum())
    printed = {"rmse": 13.2, "mae": 25.65}
    sums = {
        f"aggregate {name}": (
            bool(np.isclose(means[name.upper()], -value, atol=0.1)),
            f"that is the sum of {n} percentages, their mean is {means[name.upper()]:.2f} %",
        )
        for name, value in printed.items()
    }
    return sums | {
        "all but three": (bool((lower == n - 3).all()), counts),
        "more than half": (bool((lower > n / 2).all()), counts),
        "as well": (
            claim_rule.as_good(*over_all) == REPRODUCED,
            f"RMSE {shown(over_all[0][0])}, MAE {shown(over_all[1][0])}",
        ),
        "extremely well": (bool((well < 0).all(axis=None)), f"MAE of 00 {well['MAE']['00']:+} %"),
        "by the look": (bool((look < 0).all(axis=None)), f"MAE of 06 {look['MAE']['06']:+} %"),
        "05 higher": (bool((CHANGES.loc["05"] > 0).all()), ""),
        "04 higher": (bool(CHANGES.loc["04", "MAE"] > 0), ""),
        "widths": (best > n / 2, f"{best} of {n}"),
        "fewer": (
            bool(REDUCTION[0] <= LIMIT / kept.mean() <= REDUCTION[1]),
            f"{LIMIT / kept.mean():.1f} times",
        ),
        "a few hundred": (bool(kept.mean() <= HUNDREDS), f"{kept.mean():.0f}"),
    }


class Claim(NamedTuple):
    """One row of the table.

    name: for texts that ask for the row. where: in the thesis. says: in our words. own: by its own
    tables. here, network: numbers, of the package's network and of the thesis's. word: by the rule.
    """

    name: str
    where: str
    says: str
    own: str
    here: str
    word: str
    network: str


HEADS = (
    "where",
    "the thesis says",
    "by its own tables",
    "here",
    "word",
    "with the thesis's network",
)


def claims_of(at_hand: Tables) -> list[Claim]:
    """Return what became of each claim."""
    own, found = by_its_own_tables(), []
    for row in ROWS:
        name = row["name"]
        try:
            test = TESTS[name](at_hand)
            measured = f"{row['measured']}: " if "measured" in row else ""
            test = test._replace(here=measured + test.here)
        except NotAtHand:
            test = Found(NOT_TESTED, f"Needs {row['needs']}.")
        agrees, numbers = own.get(name, (None, ""))
        told = {None: "not in them", True: "yes", False: "no"}[agrees]
        told += f": {numbers}" if numbers else ""
        found.append(
            Claim(name, row["where"], row["says"], told, test.here, test.word, test.network)
        )
    return found


def table_of_claims(claims: list[Claim]) -> pd.DataFrame:
    """Return the table for readers."""
    lines = [[c.where, c.says, c.own, c.here, f"**{c.word}**", c.network] for c in claims]
    return pd.DataFrame(lines, columns=HEADS)


def text_of_claims(claims: list[Claim], note: str) -> str:
    """Return the page of the claims. note: on the data."""
    words = [claim.word for claim in claims]
    counts = ", ".join(f"{word} {words.count(word)}" for word in claim_rule.WORDS)
    return texts.render(
        "claims.md.j2",
        counts=counts,
        number=len(claims),
        words=claim_rule.WORDS,
        history=claim_rule.HISTORY,
        level=verdicts.LEVEL,
        table=style.markdown(table_of_claims(claims)).replace("\\`", "`"),
        note=note,
    )


def write(folder: Path, note: str) -> None:
    """Write the page of the claims into a folder in figures, from the tables there."""

    @cache
    def read(name: str) -> pd.DataFrame:
        figures = ROOT / "figures" if name.startswith(CAMVID) else folder.parent
        names = dict.fromkeys(("sequence", "row", "source", "metric", "estimator"), str)
        return pd.read_csv(figures / f"{name}.csv", dtype=names, low_memory=False)

    write_text(folder / "claims.md", text_of_claims(claims_of(Tables(read, folder.name)), note))
