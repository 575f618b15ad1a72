"""What became of the claims of the thesis: one word for each, by one rule.

**The rule.** A claim is tested in the thesis's own way: its estimator, its error, its procedure, on
the streets at hand. It is

- REPRODUCED if what it says is shown,
- NOT_REPRODUCED if the opposite is shown, or that what it says is smaller than would matter,
- CANNOT_TELL in all other cases: also if the data are not at hand, if there are too few streets,
  and if the procedure gives the same where nothing differs (`against_chance`).

A claim about one street needs this street alone. One that something can happen is shown by a street
on which it does, and is never refuted by those on which it does not.

Each function below is the rule for one kind of claim. Intervals and their levels are those of
`verdicts` and `ratios`; a difference matters from the MARGIN on. Better ways (another estimator,
other errors, a width that was fixed before) stand beside the word and do not change it: they have
verdicts of their own.

The rule was written when the tables of runs were known, and before any table of claims was made.
"""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import binomtest

from keypoint_study import comparisons, ratios, verdicts
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.path_errors import ERRORS
from keypoint_study.report import style, texts
from thesis import REPORTED, audit, equal_number, tables
from thesis_repro.odometry import THESIS

REPRODUCED, NOT_REPRODUCED = "reproduced", "not reproduced"
CANNOT_TELL = "cannot be told"
HUNDREDS = 999  # keypoints at most; the thesis calls its own 762 "a few hundred"
RULE = {  # for readers
    REPRODUCED: "what it says is shown,",
    NOT_REPRODUCED: "the opposite is shown, or that what it says is smaller than would matter (a "
    "factor of 1.25 in an error),",
    CANNOT_TELL: "neither is shown, the data are not at hand, there are fewer than six streets (but "
    "for a claim about one), or the procedure gives the same where masks do nothing. That something "
    f"can happen is not refuted by streets on which it does not. A few hundred are at most {HUNDREDS}.",
}
MARGIN = ERRORS["se3"].margin  # of the RMSE and the MAE, too: errors of a path
REAL = "kitti_excerpts/"  # tables on real frames
LIMIT = THESIS.max_keypoints
REDUCTION = REPORTED["headline_claims"]["keypoint_reduction_factor"]
SAVED = REPORTED["headline_claims"]["time_savings_percent"]
NAMED = ("00", "01", "02", "06", "08", "10")  # on which masks are said to do well
RMSE_OF_THESIS: dict[str, Any] = {"metric": "RMSE", "estimator": "thesis"}


def is_on_side(of_streets: pd.Series, side: int) -> str:
    """Return the word for a claim that errors are lower (side -1) or higher (1).

    of_streets: a ratio of errors for each street. The opposite is shown by the interval of LEVEL on
    the other side of 1. What is smaller than would matter: no difference is shown, and the interval
    of NARROW_LEVEL does not reach MARGIN on the claimed side.
    """
    typical = ratios.typical_ratio(of_streets)
    found = ratios.side_of_one(typical["low"], typical["high"])
    low, high = ratios.narrow_interval(of_streets)
    reach = high if side > 0 else 1 / low
    return _word(typical["n"], found == side, found == -side or (not found and reach < MARGIN))


def is_as_good(of_streets: pd.Series) -> str:
    """Return the word for a claim that errors are no larger.

    It is shown if the interval of NARROW_LEVEL ends below MARGIN, as for NO_WORSE; the opposite if
    that of LEVEL lies above 1, which goes first.
    """
    typical = ratios.typical_ratio(of_streets)
    larger = ratios.side_of_one(typical["low"], typical["high"]) == 1
    _, high = ratios.narrow_interval(of_streets)
    return _word(typical["n"], high < MARGIN, larger)


def is_within(interval: tuple[float, float], least: float, most: float, n: int) -> str:
    """Return the word for a claim that a number lies between two others.

    interval: of LEVEL, of a mean over n streets. Inside: shown; wholly outside: the opposite.
    """
    low, high = interval
    return _word(n, least <= low and high <= most, high < least or low > most)


def is_share(count: int, n: int, least: float) -> str:
    """Return the word for a claim that something holds on more than a share of the sequences.

    count: of n streets, on which it holds. Its share has the exact interval of LEVEL (Clopper and
    Pearson).
    """
    low, high = binomtest(count, n).proportion_ci(verdicts.LEVEL / 100)
    return _word(n, low > least, high < least)


def is_everywhere(count: int, n: int) -> str:
    """Return the word for a claim about every sequence. One exception shows the opposite."""
    return _word(n, count == n, count < n)


def is_on_one(count: int, runs: int) -> str:
    """Return the word for a claim about one named sequence: it holds in half of the runs or more.

    Repetitions are no streets, so the word is about this sequence alone.
    """
    return REPRODUCED if count >= runs / 2 else NOT_REPRODUCED


def can_happen(failing: int, failing_of_all: int) -> str:
    """Return the word for a claim that something can happen: on more streets than otherwise."""
    return REPRODUCED if failing > failing_of_all else CANNOT_TELL


def are_apart(larger: tuple[float, float], smaller: tuple[float, float]) -> str:
    """Return the word for a claim that one mean is larger than another, from their intervals.

    For tables without a value for each street. Intervals that overlap show nothing.
    """
    shown, opposite = larger[0] > smaller[1], larger[1] < smaller[0]
    return _word(verdicts.MIN_SEQUENCES, shown, opposite)


def against_chance(found: float, by_chance: Sequence[float] | np.ndarray) -> str:
    """Return the word for a claim that the thesis's procedure finds a reduction.

    found: what it finds here; by_chance: what it finds in simulated studies in which masks do
    nothing. Larger numbers are smaller reductions. Shown only by a number below the middle LEVEL
    percent of the simulated ones, the opposite by one above them.
    """
    tail = (1 - verdicts.LEVEL / 100) / 2
    low, high = np.quantile(by_chance, [tail, 1 - tail])
    return _word(verdicts.MIN_SEQUENCES, found < low, found > high)


def _word(n: int, shown: bool, opposite: bool) -> str:
    """Return the word; fewer than MIN_SEQUENCES streets tell nothing."""
    if n < verdicts.MIN_SEQUENCES:
        return CANNOT_TELL
    if opposite:
        return NOT_REPRODUCED
    return REPRODUCED if shown else CANNOT_TELL


# The table


class Claim(NamedTuple):
    """One row of the table.

    name: for texts that ask for the row. where: in the thesis. says: in our words. own: what the
    thesis's own way gives here. word: by the rule. better: what better ways give.
    """

    name: str
    where: str
    says: str
    own: str
    word: str
    better: str = ""


class Tables:
    """The tables in git that the claims are tested on. read: of one of them, by its name."""

    def __init__(self, read: Callable[[str], pd.DataFrame]) -> None:
        self.runs, self.shuffled = read(f"{REAL}runs"), read(f"{REAL}shuffled_runs")
        self.few, self.ablations = read(f"{REAL}few_keypoints_runs"), read(f"{REAL}ablations")
        self.audits = {"real": read(f"{REAL}audit"), "embedded": read("audit")}
        self.threads = read(f"{REAL}timings/seconds")["threads"].max()  # of all cores
        self.width = comparisons.tested_width(self.runs) or CONTROL_WIDTH

    def every_width(self) -> pd.DataFrame:
        """Return the runs with masks of every width and the thesis's estimator."""
        return comparisons.of_method(self.runs, "masked", "thesis")

    def runs_of(self, method: str, estimator: str = "thesis") -> pd.DataFrame:
        """Return the runs of a method; of masks, those of the tested width."""
        rows = comparisons.of_method(self.runs, method, estimator)
        return rows[rows["dilation_width"] == self.width] if method == "masked" else rows

    def over(
        self, method: str, metric: str, estimator: str = "thesis", other: str = "baseline"
    ) -> pd.Series:
        """Return the ratios of an error to that of another method, by street."""
        chosen, reference = self.runs_of(method, estimator), self.runs_of(other, estimator)
        return ratios.ratios_of(chosen, reference, metric)

    def measured(
        self, row: str, key: str, where: str = "real", threads: int = 1, **more: str
    ) -> dict[str, Any]:
        """Return value, low, high and n of a measurement of the audit, by its key in audit.json."""
        named = {"row": row, "quantity": audit.on(audit.MEASURED[row][key], threads)} | more
        rows = self.audits[where]
        (found,) = rows[(rows[list(named)] == pd.Series(named)).all(axis=1)].to_dict("records")
        return found


def claims_of(read: Callable[[str], pd.DataFrame]) -> list[Claim]:
    """Return what became of each claim. read: of a table in figures, by name."""
    at_hand = Tables(read)
    return [
        *_of_errors(at_hand),
        *_of_widths(at_hand),
        *_of_keypoints(at_hand),
        *_of_time(at_hand),
        *_of_causes(at_hand),
        *_of_the_network(at_hand),
    ]


def table_of_claims(claims: list[Claim]) -> pd.DataFrame:
    """Return the table for readers."""
    heads = ["where", "the thesis says", "here, in its own way", "word", "here, in better ways"]
    return pd.DataFrame([claim[1:] for claim in claims], columns=heads)


def text_of_claims(claims: list[Claim], note: str) -> str:
    """Return the page of the claims. note: on the data."""
    rule = " ".join(f"**{word}** if {when}" for word, when in RULE.items())
    return (
        f"# What became of the thesis's claims\n\nA claim is tested in the thesis's own way: its "
        f"estimator, its error, its procedure. It is {rule} Better ways stand beside the word and do "
        "not change it. The rule (notebooks/thesis/claims.py) was written when the runs were known, "
        f"before this table. In parentheses: {verdicts.LEVEL} % intervals over the streets; if masks did "
        "nothing, over simulated studies.\n\n"
        f"{style.markdown(table_of_claims(claims))}\n{note}\n"
    )


def _of_errors(at_hand: Tables) -> list[Claim]:
    """Return the claims about errors with masks, in the order of Section 4.2."""
    rmse, mae = (Procedure.on(at_hand, metric) for metric in ("rmse", "mae"))
    return [
        _aggregate(at_hand, rmse, "13.2"),
        _aggregate(at_hand, mae, "25.65"),
        _most_sequences(at_hand, rmse),
        _as_well(at_hand),
        _named_sequences(at_hand, rmse),
    ]


class Procedure(NamedTuple):
    """What the thesis's literal procedure gives here.

    changes: (%) of a metric, by sequence. studies: the same in simulated studies in which masks do
    nothing, one row a study.
    """

    metric: str
    changes: pd.Series
    studies: pd.DataFrame

    @classmethod
    def on(cls, at_hand: Tables, metric: str) -> "Procedure":
        """Apply the procedure to the runs at hand."""
        masked, every = at_hand.every_width(), at_hand.runs_of("baseline")
        widths = masked["dilation_width"].nunique()
        changes = tables.changes_of_repetition(masked, every, metric)
        return cls(metric, changes, tables.null_distribution(at_hand.shuffled, widths, metric))


def _aggregate(at_hand: Tables, found: Procedure, printed: str) -> Claim:
    """Return the claim on a sum of percentages. printed: in the thesis."""
    name, changes, by_chance = found.metric.upper(), found.changes, found.studies.mean(axis=1)
    low, high = tables.middle(by_chance)
    return Claim(
        f"aggregate {found.metric}",
        "4.2, 5.1",
        f"Masks lower the {name} by {printed} %, a sum of eleven percentages. (Their mean: "
        f"{audit.CHANGES[name].mean():.2f} %.)",
        f"Mean {changes.mean():.2f} %; if masks did nothing, {by_chance.mean():.2f} % "
        f"({low:.2f} to {high:.2f}).",
        against_chance(changes.mean(), by_chance),
        f"Sum here: {changes.sum():.0f} %. Width {at_hand.width}, fixed before: "
        f"{_ratio(at_hand.over('masked', found.metric))} times the error of all keypoints.",
    )


def _most_sequences(at_hand: Tables, found: Procedure) -> Claim:
    """Return the claim that errors fall on most sequences."""
    improved, by_luck = (found.changes < 0).sum(), (found.studies < 0).sum(axis=1)
    in_tables = (audit.CHANGES < 0).sum()
    fixed = at_hand.over("masked", "rmse")
    return Claim(
        "most sequences",
        "4.2, 5.1",
        f"Errors fall on all sequences but three. (In its tables: RMSE on {in_tables['RMSE']}, MAE "
        f"on {in_tables['MAE']} of 11.)",
        f"RMSE lower on {improved} of {len(found.changes)}; on {by_luck.mean():.2f} if masks did "
        "nothing.",
        against_chance(-improved, -by_luck.to_numpy()),
        f"Width {at_hand.width}: lower on {(fixed < 1).sum()} of {len(fixed)}.",
    )


def _as_well(at_hand: Tables) -> Claim:
    """Return the claim that masks do as well as all keypoints."""
    fixed = at_hand.over("masked", "rmse")
    shuffles = ratios.range_of_shuffles(at_hand.runs).query("estimator == 'thesis'")["factor"]
    refined = pd.DataFrame(
        {error: at_hand.over("masked", error, "refined") for error in comparisons.JUDGING_METRICS}
    )
    at_random = ("random", 200)
    equal = equal_number.over(*_few(at_hand.few, ("mask", 200), at_random))
    places = equal_number.over(*_few(at_hand.few, ("random-on", 200), at_random))
    return Claim(
        "as well",
        "4, 4.2, 5.1",
        "Masks do as well as all keypoints, or slightly better.",
        f"Width {at_hand.width}: RMSE {_ratio(fixed)} times that of all, higher on "
        f"{(fixed > 1).sum()} of {len(fixed)}.",
        is_as_good(fixed),
        "Within the numerical accuracy, says the thesis: shuffling the points alone changes the RMSE "
        f"by a factor of {shuffles.median():.2f}, at most {shuffles.max():.2f}. Refined estimator: "
        f"aligned ATE {_ratio(refined['se3'])}, rotation {_ratio(refined['rotation'])}: "
        f"{equal_number.word(refined)}. At an equal number, 200 over 200 random ones, thesis's "
        f"estimator: {_judged(equal)}; random ones on the mask: {_judged(places)}.",
    )


def _judged(of_streets: pd.DataFrame) -> str:
    """Return the typical ratios of both deciding errors, and their word."""
    errors = ", ".join(_ratio(of_streets[error]) for error in comparisons.JUDGING_METRICS)
    return f"{errors}: {equal_number.word(of_streets)}"


def _named_sequences(at_hand: Tables, found: Procedure) -> Claim:
    """Return the claim on sequences on which masks do well."""
    changes = found.changes
    shown = ", ".join(f"{name} {changes[name]:+.0f} %" for name in NAMED if name in changes)
    failed = [_failed(at_hand.runs_of(method), "01") for method in ("masked", "baseline")]
    return Claim(
        "named sequences",
        "4.2",
        "Masks do extremely well on 00, 01, 02, 08 and 10, and by the look of the paths on 06.",
        f"RMSE of the best width: {shown}. The others are not at hand.",
        CANNOT_TELL,
        f"On 01, runs fail, with masks ({failed[0]}) and with all keypoints ({failed[1]}).",
    )


def _of_widths(at_hand: Tables) -> list[Claim]:
    """Return the claims about the dilation width."""
    masked = at_hand.every_width()
    best = tables.best_widths(masked)["dilation_width"].isin(audit.WIDTHS)
    kept = masked.groupby(["sequence", "dilation_width"])["mean_keypoints"].mean().unstack()
    rising = kept.diff(axis=1).iloc[:, 1:].gt(0).all(axis=1)
    same = at_hand.measured("2", "same best")
    others = at_hand.measured("35", "9 to 11", estimator="thesis")
    return [
        Claim(
            "widths",
            "4.2, Table 4.1",
            "For most sequences, widths of 9 to 11 have the lowest error (7 of 11).",
            f"{best.sum()} of {len(best)}.",
            is_share(int(best.sum()), len(best), 0.5),
            f"Two repetitions have the same best width in {same['value']:.0f} % of cases. But the RMSE "
            f"of these widths is {_numbers(others)} times that of the others.",
        ),
        Claim(
            "wider",
            "4.2, Figure 4.7",
            "In all sequences, wider masks keep more keypoints.",
            f"In {rising.sum()} of {len(rising)}.",
            is_everywhere(int(rising.sum()), len(rising)),
        ),
    ]


def _of_keypoints(at_hand: Tables) -> list[Claim]:
    """Return the claims about the number of keypoints."""
    best = tables.best_widths(at_hand.every_width())["mean_keypoints"]
    reported = pd.DataFrame(REPORTED["table_4_1"])["mean_keypoints"].mean()
    return [
        _fewer(at_hand, best, reported),
        _a_few_hundred(at_hand, best, reported),
        _plainly_reduced(at_hand),
        _more_keypoints(at_hand),
        _tenth_lost(at_hand),
    ]


def _fewer(at_hand: Tables, best: pd.Series, reported: float) -> Claim:
    """Return the claim on a factor. best: keypoints at the best widths. reported: their mean."""
    factor = ratios.typical_ratio(LIMIT / best)
    fixed = at_hand.runs_of("masked").groupby("sequence")["mean_keypoints"].mean()
    every = at_hand.runs_of("baseline").groupby("sequence")["mean_keypoints"].mean()
    return Claim(
        "fewer",
        "4.2, 5.1",
        f"Keypoints are reduced 3 to 5 times. (In its Table 4.1: {LIMIT / reported:.1f}.)",
        f"Best widths: {_ratio(LIMIT / best, False)} times fewer than {LIMIT}.",
        is_within((factor["low"], factor["high"]), REDUCTION[0], REDUCTION[1], len(best)),
        f"Width {at_hand.width}: {every.mean() / fixed.mean():.1f} times, {every.mean():.0f} to "
        f"{fixed.mean():.0f}.",
    )


def _a_few_hundred(at_hand: Tables, best: pd.Series, reported: float) -> Claim:
    """Return the claim on a number. best, reported: as above."""
    low, high = ratios.mean_interval(best)
    spread = equal_number.over(*_few(at_hand.few, ("spread", 200), ("all", 0)))
    return Claim(
        "a few hundred",
        "Abstract",
        f"Keypoints are limited to a few hundred. (In its Table 4.1: {reported:.0f}.)",
        f"Best widths: {best.mean():.0f} ({low:.0f}-{high:.0f}).",
        is_within((low, high), 1, HUNDREDS, len(best)),
        f"200 spread over the frame, over all: aligned ATE {_ratio(spread['se3'])}, rotation "
        f"{_ratio(spread['rotation'])}.",
    )


def _plainly_reduced(at_hand: Tables) -> Claim:
    """Return the claim that as few keypoints without masks are worse."""
    reduced = at_hand.over("reduced", "rmse")
    of_masks = at_hand.measured("33", "over best", estimator="thesis")
    return Claim(
        "plainly reduced",
        "4.2, Figures 4.12 to 4.16",
        "As few keypoints without masks have significantly higher errors.",
        f"RMSE {_ratio(reduced)} times that of all.",
        is_on_side(reduced, 1),
        f"Rotation {_ratio(at_hand.over('reduced', 'rotation'))}. RMSE over masks of the best width: "
        f"{_numbers(of_masks)}. Aligned ATE of the strongest, as many as masks of width "
        f"{at_hand.width} leave: {_ratio(at_hand.over('fewer', 'se3'))}.",
    )


def _more_keypoints(at_hand: Tables) -> Claim:
    """Return the claim that more keypoints are worse."""
    fewer = at_hand.over("fewer", "rmse")
    return Claim(
        "more keypoints",
        "4.2",
        "More keypoints make RANSAC err more.",
        f"As few of the strongest as masks leave, over all: RMSE {_ratio(fewer)}.",
        is_on_side(fewer, -1),
    )


def _tenth_lost(at_hand: Tables) -> Claim:
    """Return the claim on a tenth of the keypoints."""
    tenth = at_hand.measured("59", "dropout", **RMSE_OF_THESIS)
    failing, failing_of_all = _failing(at_hand, "dropout"), _failing(at_hand, "baseline")
    return Claim(
        "a tenth lost",
        "2.2.2",
        "Without less than a tenth of the keypoints, the position can be lost.",
        f"Without a random tenth, {failing} of {tenth['n']:.0f} streets fail, with all "
        f"{failing_of_all}.",
        can_happen(failing, failing_of_all),
        f"RMSE {_numbers(tenth)} times that of all.",
    )


def _of_time(at_hand: Tables) -> list[Claim]:
    """Return the claims about time. Times are those of the machine that made the evidence."""
    total, typical = at_hand.measured("47", "together"), at_hand.measured("47", "typical")
    of_all_cores = at_hand.measured("47", "typical", threads=at_hand.threads)
    narrow = at_hand.measured("47", "narrow")
    whole = at_hand.measured("16", "network")
    return [
        Claim(
            "time",
            "4.2, 5.1",
            "Widths of 9 to 11 save 5 to 10 % of the time.",
            f"{audit.on('One machine', at_hand.threads)}: {_saved(of_all_cores)}.",
            is_within(_saved_ends(of_all_cores), SAVED[0], SAVED[1], of_all_cores["n"]),
            f"On one thread: {_saved(typical)}; all streets together (Equation 4.2): "
            f"{-total['value']:.0f} %. "
            "With the package's network, which is smaller than the thesis's, a frame takes about "
            f"{whole['value']:.0f} times as long as without masks.",
        ),
        Claim(
            "narrow masks",
            "4.2, Figure 4.17",
            "Smaller widths save more time.",
            f"The time with masks of width 1 is {_numbers(narrow)} times that of width 15.",
            _of_interval(narrow, -1),
        ),
    ]


def _of_causes(at_hand: Tables) -> list[Claim]:
    """Return the claims about what causes errors."""
    turns = at_hand.over("masked", "in_turns")
    steady = at_hand.measured("38", "steady", "embedded", estimator="refined")
    on_01 = ratios.has_failed(at_hand.runs_of("baseline").query("sequence == '01'"))
    refined_on_01 = _failed(at_hand.runs_of("baseline", "refined"), "01")
    thin, thin_high = at_hand.measured("87", "thin 5/15"), at_hand.measured("87", "thin 20/60")
    lost = at_hand.measured("73", "lost", metric="all")
    lost_on_masks = at_hand.measured("73", "lost", metric="on predicted boundaries")
    return [
        Claim(
            "sequence 01",
            "4.2, Figure 4.6",
            "On 01, the path with all keypoints soon leaves the true one.",
            f"{on_01.sum()} of {len(on_01)} runs fail.",
            is_on_one(int(on_01.sum()), len(on_01)),
            f"With the refined estimator: {refined_on_01}.",
        ),
        Claim(
            "turns",
            "4.2",
            "Masks lose accuracy in turns, where half of the scene is new.",
            f"Rotation errors in turns: {_ratio(turns)} times those of all.",
            is_on_side(turns, 1),
            f"Refined estimator: {_ratio(at_hand.over('masked', 'in_turns', 'refined'))}.",
        ),
        Claim(
            "changing boundaries",
            "4.2, 5.1, 5.2.1",
            "Boundaries that change between frames raise the error with masks.",
            "No street at hand has label maps without changes.",
            CANNOT_TELL,
            f"Embedded world, true label maps: RMSE {_numbers(steady)} times that of predicted ones "
            "(refined estimator).",
        ),
        Claim(
            "thin things",
            "4.2",
            "Thresholds as low as 5 and 15 are needed to find poles and signs.",
            f"{thin['value']:.0f} % of their boundary pixels have an edge; with 20 and 60, "
            f"{thin_high['value']:.0f} %.",
            are_apart(_ends(thin), _ends(thin_high)),
        ),
        Claim(
            "found again",
            "2.2.3, 3.6, 5.1",
            "Keypoints on boundaries are found again in the next frames.",
            f"Not found again: {lost_on_masks['value']:.0f} % on boundaries, "
            f"{lost['value']:.0f} % of all, in a few pairs of frames.",
            CANNOT_TELL,
        ),
        Claim(
            "after turns",
            "4.2, Figure 4.6",
            "Paths do not return to their start on 00, 06 and 07.",
            "The excerpts are too short to return.",
            CANNOT_TELL,
        ),
        Claim(
            "ORB-SLAM2",
            "3.8",
            "PySLAM has ten times the error of ORB-SLAM2.",
            "ORB-SLAM2 was not run.",
            CANNOT_TELL,
        ),
    ]


def _of_the_network(at_hand: Tables) -> list[Claim]:
    """Return the claims about the network. Cityscapes is not at hand."""
    small = at_hand.measured("86", "small", "embedded")["value"]
    large = at_hand.measured("86", "large", "embedded")["value"]
    library = at_hand.measured("20", "library", "embedded")["value"]
    whole = at_hand.measured("20", "whole", "embedded")["value"]
    sky = at_hand.measured("46", "sky", "embedded")["value"]
    return [
        Claim(
            "scores",
            "4.1",
            "IoU 0.46 and F1 0.55 in training, 0.35 and 0.41 in validation, after 24 epochs.",
            "Cityscapes is not at hand, and nothing was trained on it.",
            CANNOT_TELL,
            f"Embedded world: the library's IoU score is {library:.2f} where one confusion matrix "
            f"gives {whole:.2f}.",
        ),
        Claim(
            "large and small",
            "4.1, Figure 4.2",
            "The network does well on large objects and struggles with small ones.",
            "Cityscapes is not at hand.",
            CANNOT_TELL,
            f"Embedded world: {large:.0f} % and {small:.0f} % of their pixels are right.",
        ),
        Claim(
            "sky",
            "4.1, Figure 4.3",
            "On KITTI, the network misses large parts of the sky.",
            "The streets at hand have no true label maps.",
            CANNOT_TELL,
            f"Embedded world: {sky:.0f} % of the sky is found.",
        ),
        Claim(
            "other data",
            "4.1, Figure 4.3",
            "The network is worse on KITTI than on the images that it was trained for.",
            "Cityscapes is not at hand.",
            CANNOT_TELL,
            "So is the package's network (its card).",
        ),
    ]


def _few(few: pd.DataFrame, *choices: tuple[str, int]) -> list[pd.DataFrame]:
    """Return the runs of some choices of keypoints (choice, number), 0 for no limit."""
    few = few[few["estimator"] == "thesis"]
    return [few[(few["choice"] == name) & (few["number"] == number)] for name, number in choices]


def _failing(at_hand: Tables, method: str) -> int:
    """Return on how many streets an ablation fails."""
    runs = comparisons.of_method(at_hand.ablations, method, "thesis")
    return ratios.failing_sequences(ratios.has_failed(runs).set_axis(runs["sequence"]))


def _failed(runs: pd.DataFrame, street: str) -> str:
    """Return how many runs over a street failed."""
    return ratios.count_failed(runs[runs["sequence"] == street])


def _of_interval(measured: dict[str, Any], side: int) -> str:
    """Return the word of `is_on_side` for a ratio of the audit, which has one interval alone.

    The interval of LEVEL is a little wider than that of NARROW_LEVEL, so less is called too small.
    """
    low, high = _ends(measured)
    found = ratios.side_of_one(low, high)
    too_small = not found and (high if side > 0 else 1 / low) < MARGIN
    return _word(int(measured["n"]), found == side, found == -side or too_small)


def _saved_ends(measured: dict[str, Any]) -> tuple[float, float]:
    """Return how many percent of the time are saved, from the interval of a ratio of times."""
    low, high = _ends(measured)
    return 100 * (1 - high), 100 * (1 - low)


def _saved(measured: dict[str, Any]) -> str:
    low, high = _saved_ends(measured)
    return f"{100 * (1 - measured['value']):.0f} % ({low:.0f} to {high:.0f})"


def _ends(measured: dict[str, Any]) -> tuple[float, float]:
    return measured["low"], measured["high"]


def _numbers(measured: dict[str, Any]) -> str:
    """Return a measurement of the audit as text: "0.95 (0.56-1.00) ↓"."""
    return texts.short({"ratio": measured["value"], **measured})


def _ratio(of_streets: pd.Series, marked: bool = True) -> str:
    """Return the typical ratio of streets as text, with an arrow if it is marked."""
    text = texts.short(ratios.typical_ratio(of_streets))
    return text if marked else text.rstrip(" ↑↓")
