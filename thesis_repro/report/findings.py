"""What the results show, in words that the numbers choose.

A difference is only called one where its bootstrap interval over sequences excludes zero and there are enough
sequences for that to mean something; everything else "cannot be told apart".
"""

from itertools import combinations
from math import comb

import numpy as np

from thesis_repro.study import results
from thesis_repro.study.jobs import CONTROL_WIDTH, POSES
from thesis_repro.study.results import CONTROLS, LEVEL

# Below this, changes of one sign in all sequences happen by chance more often than one time in twenty (2 / 2**n), and
# an interval drawn from so few is too narrow.
ENOUGH = 6
FEWEST_REPETITIONS = 4  # that fall apart by chance in less than one sequence of twenty
UNAIDED = ("other-frame", "mirrored", "random-lines", "image-edges", "fewer", "spread")  # know no class of the frame
SAME = "cannot be told apart from"
NAMES = {"baseline": "all keypoints", **CONTROLS}


def verdict(differences):
    """-1 where the mean of one difference a sequence is shown to be below zero, 1 where above, 0 where neither."""
    values = np.asarray(differences, float)
    if np.count_nonzero(~np.isnan(values)) < ENOUGH:
        return 0
    low, high = results.interval(values)
    return -1 if high < 0 else 1 if low > 0 else 0


def study_words(summary, data):
    """The same on a summary with several sources of masks: each by itself, then one against the other."""
    parts = [_about(summary, data), _chance(summary)]
    for source in results.sources(summary):
        own = results.of_source(summary, source)
        parts += [f"### {source}", _again(own), _choice(own), *(_against_controls(own, pose) for pose in POSES)]
    parts += [_against_each_other(summary, pose) for pose in POSES]
    return "\n\n".join(part for part in parts if part) + "\n"


def words(summary, data, label_maps=None):
    """A Markdown text on what a summary of runs shows; data: one line that says where they come from.

    label_maps: one line on how good these are (`gap.line`).
    """
    parts = [_about(summary, data), _label_maps(label_maps), f"{_chance(summary)} {_again(summary)}".strip(),
             _choice(summary)]
    parts += [_against_controls(summary, pose) for pose in POSES]
    return "\n\n".join(part for part in parts if part) + "\n"


def _about(summary, data):
    baseline = results.of_variant(summary, "baseline")
    frames = baseline.groupby("sequence")["frames"].first()
    text = (f"**What was run.** Data: {data}. {_number(len(frames), 'sequence')} ({', '.join(frames.index)}), "
            f"{_from_to(frames)} frames each, {_number(baseline['repetition'].nunique(), 'repetition')} of every run "
            "with the correspondences in another order. Changes are Equation 4.1, of means over the repetitions, "
            "negative where the error is smaller.")
    if len(frames) >= results.FEWEST:
        text += f" Brackets hold the {LEVEL} % bootstrap interval of their mean over sequences."
    if len(frames) < ENOUGH:
        text += (f" With fewer than {ENOUGH} sequences even changes of one sign in all of them are no rare chance, so "
                 "nothing here is said of sequences in general.")
    else:
        text += (" A difference is called one only where its interval excludes zero, which one comparison in twenty "
                 "does by chance.")
    return text


def _label_maps(said):
    return said and f"**How good the label maps are.** {said[0].upper()}{said[1:]}."


def _chance(summary):
    baseline = results.of_variant(summary, "baseline")
    if baseline["repetition"].nunique() < 2:
        return "**How much is chance.** One repetition cannot say how much of any difference is chance."
    errors = results.over_orders(baseline, "rmse")
    ratio = errors["highest"] / errors["lowest"]
    widest = f" and up to {ratio.max():.2g} times ({ratio.idxmax()})" if len(ratio) > 1 else ""
    return ("**How much is chance.** With all keypoints, the order of the correspondences alone makes the highest RMSE "
            f"of a sequence {ratio.median():.2g} times its lowest (median over sequences){widest}.")


def _again(summary):
    """Whether the best width is so again where the order of the correspondences is another."""
    stability = results.stability(summary).dropna()
    number = results.of_variant(summary, "masked")["dilation_width"].nunique()
    if stability.empty or number < 2:
        return ""
    promised = results.widths(summary).loc[stability.index, "best_rmse"]
    return ("A sequence's best width in one repetition is the best in another "
            f"{stability['same_best'].mean():.0f} times in 100; lots drawn among {number} widths would agree "
            f"{100 / number:.0f} times. Chosen in one repetition and judged in the others, it changes RMSE by "
            f"{_signed(stability['elsewhere'].mean())} % on average; chosen and judged by the same runs, as in "
            f"the thesis, by {_signed(promised.mean())} %.")


def _choice(summary):
    table = results.widths(summary)
    if table.empty or results.of_variant(summary, "masked")["dilation_width"].nunique() < 2:
        return ""
    text = (f"**Masks against all keypoints, {POSES[results.main_pose(summary)]}.** With the width of the lowest RMSE "
            f"on each sequence (the thesis says RMSE and/or MAE): {_changes(table, 'best')}. That choice favours masks "
            "even where they do nothing, so it is no test.")
    if len(table) > 1:
        text += (f" With one width for all ({table['fixed'].iloc[0]}), chosen on the same sequences too: "
                 f"{_changes(table, 'fixed')}. With the width that the other sequences choose: "
                 f"{_changes(table, 'left_out')}; that is no longer favoured, but the choices hang together and an "
                 f"interval would be too narrow. {_tested(summary)}")
    return text.strip()


def _tested(summary):
    """Where the width that is put to the test comes from."""
    width = results.tested_width(summary)
    if "masked" not in results.control_changes(summary, "rmse"):
        return ""
    if width != CONTROL_WIDTH:
        return (f"The test below is of the width {width}, set in place of Section 3.6's {CONTROL_WIDTH}; it is a fair "
                "one if it was set before any run was seen.")
    text = f"The test below is of the width {width}, that of Section 3.6, fixed before any run"
    return f"{text}." if width in set(results.best_widths(summary)["dilation_width"]) else (
        f"{text}; it is the best width of no sequence.")


def _changes(table, choice):
    return " and ".join(f"{metric.upper()} {_signed(changes.mean())} % ({_improved(changes)})"
                        for metric in ("rmse", "mae") for changes in [table[f"{choice}_{metric}"]])


def _judged(changes):
    said = {-1: "is smaller than", 0: SAME, 1: "is larger than"}[verdict(changes)]
    return (f"{said} that of all keypoints ({_mean(changes)}, median {_signed(changes.median())} %, "
            f"{_improved(changes)})")


def _against_controls(summary, pose):
    changes = results.control_changes(summary, "rmse", pose)
    if "masked" not in changes:
        return ""
    width, others = results.tested_width(summary), [variant for variant in changes if variant != "masked"]
    masks = "These masks" if width is None else f"Masks of width {width}"
    text = (f"**{masks}{' and the controls' if others else ''}, {POSES[pose]}.** With masks RMSE "
            f"{_judged(changes['masked'])}.")
    signs = {variant: verdict(changes["masked"] - changes[variant]) for variant in others}
    for sign, said in ((-1, "is smaller than with"), (1, "is larger than with"), (0, f"{SAME} that with")):
        found = [f"{CONTROLS[variant]} ({_mean(changes['masked'] - changes[variant], ' points')})"
                 for variant in others if signs[variant] == sign]
        if found:
            text += f" It {said} {', '.join(found)}."
    return text + _in_sequences(summary, others, pose) + _conclusion(changes["masked"], signs)


def _against_each_other(summary, pose):
    changes, called = {}, {}
    for source in results.sources(summary):
        own = results.of_source(summary, source)
        found, width = results.control_changes(own, "rmse", pose), results.tested_width(own)
        if "masked" in found:
            changes[source] = found["masked"]
            called[source] = source if width is None else f"{source} (width {width})"
    said = {-1: "is smaller than with", 0: f"{SAME} that with", 1: "is larger than with"}
    found = [f"with {called[one]} RMSE {said[verdict(changes[one] - changes[other])]} {called[other]} "
             f"({_mean(changes[one] - changes[other], ' points')})" for one, other in combinations(changes, 2)]
    if not found:
        return ""
    text = "; ".join(found)
    return f"### One against the other, {POSES[pose]}\n\nChanges from all keypoints compared: {text}."


def _in_sequences(summary, others, pose):
    """In which sequences the repetitions with masks do not overlap those of another variant."""
    masked = results.of_control(summary, "masked", pose)
    repetitions = masked["repetition"].nunique()
    if repetitions < FEWEST_REPETITIONS:
        return ""
    found, count = [], 0
    for variant in ("baseline", *others):
        rows = results.of_control(summary, variant, pose)
        count += rows["sequence"].isin(masked["sequence"]).groupby(rows["sequence"]).any().sum()
        said = [f"{word} in {', '.join(names) if len(names) <= 3 else f'{len(names)} sequences'}"
                for word, names in zip(("better", "worse"), results.apart(masked, rows)) if names]
        if said:
            found.append(f"{NAMES[variant]} ({'; '.join(said)})")
    expected = 2 / comb(2 * repetitions, repetitions) * count
    if not found:
        return " In no single sequence do all repetitions with masks lie on one side of all those of another variant."
    return (f" In single sequences, every repetition with masks is better or worse than every one with "
            f"{', '.join(found)}; of {count} such comparisons chance alone would give {expected:.1g}.")


def _conclusion(change, signs):
    signs = {variant: sign for variant, sign in signs.items() if variant in UNAIDED}
    if not signs:
        return ""
    count = int(change.notna().sum())
    if count < ENOUGH:
        return (f" **{_number(count, 'sequence')} cannot tell whether masks help, nor whether it is the segmentation "
                "that does.**")
    helps = {-1: "Masks help here", 0: "Masks are not shown to help here", 1: "Masks do harm here"}[verdict(change)]
    beaten = [variant for variant, sign in signs.items() if sign < 0]
    if len(beaten) == len(signs):
        why = "the segmentation matters: every control without it does worse"
    elif beaten:
        rest = [CONTROLS[variant] for variant in signs if variant not in beaten]
        why = f"the segmentation is not shown to matter, as these are not shown to do worse: {', '.join(rest)}"
    else:
        why = "the segmentation is not shown to matter: no control without it is shown to do worse"
    return f" **{helps}, and {why}.**" if verdict(change) or len(beaten) < len(signs) else f" **{helps}, but {why}.**"


def _mean(values, unit=" %"):
    low, high = results.interval(values)
    bracket = "" if np.isnan(low) else f" [{_signed(low)}, {_signed(high)}]"
    return f"{_signed(np.nanmean(values))}{unit}{bracket}"


def _improved(changes):
    return f"better in {(changes < 0).sum()} of {changes.notna().sum()}"


def _signed(value):
    return f"{value:+.0f}" if abs(value) >= 9.95 else f"{value:+.1f}"


def _from_to(values):
    return f"{min(values)}" if min(values) == max(values) else f"{min(values)} to {max(values)}"


def _number(count, noun):
    return f"{count} {noun}{'s' * (count != 1)}"
