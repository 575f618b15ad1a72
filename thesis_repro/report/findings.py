"""What the results show, in words that the numbers choose.

Errors are compared as ratios within a sequence, on a logarithmic scale (`study.answer`), so that half and double weigh
the same and no single sequence carries a mean. A difference is only called one where its bootstrap interval over
sequences excludes a ratio of 1 and there are enough sequences for that to mean something; everything else "cannot be
told apart".
"""

from itertools import combinations

import numpy as np

from thesis_repro.study import answer, results
from thesis_repro.study.jobs import CONTROL_WIDTH, ESTIMATORS
from thesis_repro.study.results import CONTROLS, LEVEL

# Below this, changes of one sign in all sequences happen by chance more often than one time in twenty (2 / 2**n), and
# an interval drawn from so few is too narrow.
ENOUGH = 6
UNAIDED = ("other-frame", "mirrored", "random-lines", "image-edges", "fewer", "spread")  # know no class of the frame
NAMES = {"baseline": "all keypoints", **CONTROLS}
CHOICES = {"best": "the best of each sequence, on itself (as in the thesis)", "fixed": "one for all, on themselves",
           "left_out": "by the other sequences"}


def verdict(ratios):
    """-1 where the mean of one ratio a sequence is shown to be below 1, 1 where above, 0 where neither."""
    values = np.log(np.asarray(ratios, float))
    if np.count_nonzero(~np.isnan(values)) < ENOUGH:
        return 0
    low, high = results.interval(values)
    return -1 if high < 0 else 1 if low > 0 else 0


def study_words(summary, data):
    """A Markdown text on several sources of masks: each by itself, then one against the other."""
    parts = [_about(summary, data), _chance(summary)]
    for source in results.sources(summary):
        own = results.of_source(summary, source)
        parts += [f"### {source}", " ".join(said for estimator in ESTIMATORS if (said := _masks(own, estimator))), _controls(own),
                  _beside(own), _choice(own)]
    parts += [_against_each_other(summary, estimator) for estimator in ESTIMATORS]
    return "\n\n".join(part for part in parts if part) + "\n"


def words(summary, data, label_maps=None, quality=None):
    """A Markdown text on what a summary of runs shows; data: one line that says where they come from.

    label_maps: one line on how good these are (`gap.line`). quality: the same in short, for verdicts (`gap.quality`).
    """
    short = [_about(summary, data), label_maps and f"{label_maps[0].upper()}{label_maps[1:]}.", _chance(summary),
             *(_masks(summary, estimator, quality) for estimator in ESTIMATORS)]
    if "embedded" in data.split(";")[0]:
        short.append("These are rendered streets: nothing here is evidence about KITTI.")
    parts = ["\n".join(f"- {part}" for part in short if part), _controls(summary), _beside(summary), _choice(summary)]
    return "\n\n".join(part for part in parts if part) + "\n"


def _about(summary, data):
    baseline = results.of_method(summary, "baseline")
    frames = baseline.groupby("sequence")["frames"].first()
    runs = baseline["repetition"].nunique()
    orders = f"{runs} repetitions of every run with the correspondences in another order" if runs > 1 else "once each"
    return (f"{_number(len(frames), 'sequence')} ({', '.join(frames.index)}; {frames.sum():,} frames), with all "
            f"keypoints, with masks and with controls, {orders} ({data}).")


def _chance(summary):
    baseline = results.of_method(summary, "baseline")
    if baseline["repetition"].nunique() < 2:
        return "One repetition cannot say how much of any difference is chance."
    errors = results.over_orders(baseline, "rmse")
    ratio = errors["highest"] / errors["lowest"]
    widest = f", up to {ratio.max():.2g} times ({ratio.idxmax()})" if len(ratio) > 1 else ""
    return (f"The order of the correspondences alone makes the highest RMSE of a sequence {ratio.median():.2g} times "
            f"its lowest with all keypoints (median over sequences{widest}).")


def _compared(summary, estimator):
    """The masks of the tested width over all keypoints, and over each control: {method: ratio of each sequence}."""
    masked = results.of_control(summary, "masked", estimator)
    every = results.of_method(summary, "baseline", estimator)
    if not len(masked) or not len(every):
        return {}
    others = {method: results.of_control(summary, method, estimator) for method in CONTROLS if method != "masked"}
    return {"baseline": answer.ratios(masked, every, "rmse"),
            **{method: answer.ratios(masked, rows, "rmse") for method, rows in others.items() if len(rows)}}


def _masks(summary, estimator, quality=None):
    """What masks of the tested width do under one estimator, and whether it is the segmentation that does it."""
    compared = _compared(summary, estimator)
    if not compared:
        return ""
    change, width = compared["baseline"], results.tested_width(summary)
    masks = "masks" if width is None else f"masks of width {width}"
    of_quality = f" from label maps of {quality}" if quality else ""
    text = (f"Under the {ESTIMATORS[estimator].replace(' estimator', '')} estimator {masks} make RMSE {_times(change)} that of "
            f"all keypoints ({_lower(change)}).")
    count = int(change.notna().sum())
    if count < ENOUGH:
        return (f"{text} {_number(count, 'sequence')} cannot tell whether masks help, nor whether the segmentation "
                "does.")
    helps = {-1: "help", 0: "are not shown to help", 1: "do worse than all keypoints"}[verdict(change)]
    text += f" **Masks{of_quality} {helps} here"
    signs = {method: verdict(ratio) for method, ratio in compared.items() if method in UNAIDED}
    if not signs:
        return f"{text}.**"
    beaten = [method for method, sign in signs.items() if sign < 0]
    if len(beaten) == len(signs):
        return f"{text}, and the segmentation matters: every control without it does worse.**"
    if beaten:
        rest = ", ".join(CONTROLS[method] for method in signs if method not in beaten)
        return f"{text}, and the segmentation is not shown to matter: not shown to do worse are {rest}.**"
    return f"{text}, and the segmentation is not shown to matter: no control without it is shown to do worse.**"


def _beside(summary):
    """What errors say that no constant angle between camera and truth moves, the same masks over all keypoints."""
    said = []
    for estimator, name in ESTIMATORS.items():
        masked, every = results.of_control(summary, "masked", estimator), results.of_method(summary, "baseline", estimator)
        found = {kind: answer.ratios(masked, every, metric) for metric, kind in results.BESIDE.items()}
        of_pose = [f"{kind} {_times(ratios)}" for kind, ratios in found.items() if len(ratios)]
        if of_pose:
            said.append(f"{name}: {', '.join(of_pose)}")
    return f"**Masks by other errors, times all keypoints.** {'; '.join(said)}." if said else ""


def _controls(summary):
    """A Markdown table: every method as times all keypoints, and masks as times it, under each estimator."""
    found = {estimator: answer.compared(summary, "rmse", estimator) for estimator in ESTIMATORS if _compared(summary, estimator)}
    if not found:
        return ""
    head = "| RMSE | keypoints | " + " | ".join(f"{ESTIMATORS[estimator]}: times all keypoints | masks are times this"
                                                for estimator in found) + " |"
    lines = [head, "| :--- | ---: |" + " :--- | :--- |" * len(found)]
    names = results.control_names(summary)
    rows = {estimator: table.set_index("method") for estimator, table in found.items()}
    for method in next(iter(rows.values())).index.drop("baseline"):
        cells = []
        for table in rows.values():
            row = table.loc[method] if method in table.index else None
            cells += ["", ""] if row is None else [
                _ratio(row["ratio"], row["low"], row["high"]),
                "" if method == "masked" else _ratio(row["masks"], row["masks_low"], row["masks_high"])]
        keypoints = next(table.loc[method, "keypoints"] for table in rows.values() if method in table.index)
        lines.append(f"| {names[method]} | {keypoints:.0f} | {' | '.join(cells)} |")
    note = (f"Geometric means over sequences; in brackets their {LEVEL} % bootstrap interval, where there are "
            f"{results.FEWEST} or more. A ratio whose interval holds 1 shows no difference; of those that exclude it, "
            "one in twenty does so by chance.")
    return "\n".join(["**Masks and controls, in numbers.** " + note, "", *lines])


def _choice(summary):
    """What the choice of width makes of the comparison: a Markdown table and what it is worth."""
    table, number = results.widths(summary), results.of_method(summary, "masked")["dilation_width"].nunique()
    if table.empty or number < 2:
        return ""
    lines = ["| width chosen | RMSE, times all keypoints | lower in | MAE, times all keypoints | lower in |",
             "| :--- | :--- | :--- | :--- | :--- |"]
    for choice, name in CHOICES.items():
        changes = {metric: table[f"{choice}_{metric}"].dropna() for metric in ("rmse", "mae")}
        if len(changes["rmse"]) and (choice == "best" or len(table) > 1):
            cells = [cell for metric in ("rmse", "mae")
                     for cell in (f"{np.exp(np.log1p(changes[metric] / 100).mean()):.2f}", _lower_of(changes[metric]))]
            lines.append(f"| {name} | {' | '.join(cells)} |")
    text = (f"**The choice of width, {ESTIMATORS[results.main_estimator(summary)]}.** The best of {number} widths looks good "
            "even where masks do nothing, so it is no test.")
    return "\n".join([f"{text} {_again(summary, number)}{_tested(summary)}".strip(), "", *lines])


def _again(summary, number):
    """Whether the best width is so again where the order of the correspondences is another."""
    stability = results.stability(summary).dropna()
    if stability.empty:
        return ""
    return (f"A sequence's best width in one repetition is the best in another {stability['same_best'].mean():.0f} "
            f"times in 100; lots drawn among {number} would agree {100 / number:.0f} times. ")


def _tested(summary):
    """Where the width that is put to the test comes from."""
    width = results.tested_width(summary)
    if not _compared(summary, results.main_estimator(summary)):
        return ""
    if width != CONTROL_WIDTH:
        return (f"The width put to the test is {width}, set in place of Section 3.6's {CONTROL_WIDTH}; the test is "
                "fair if it was set before any run was seen.")
    text = f"The width put to the test is {width}, that of Section 3.6, fixed before any run"
    return f"{text}." if width in set(results.best_widths(summary)["dilation_width"]) else (
        f"{text}; it is the best width of no sequence.")


def _against_each_other(summary, estimator):
    masked, called = {}, {}
    for source in results.sources(summary):
        own = results.of_source(summary, source)
        rows, width = results.of_control(own, "masked", estimator), results.tested_width(own)
        if len(rows):
            masked[source] = rows
            called[source] = source if width is None else f"{source} (width {width})"
    said = {-1: "is smaller than with", 0: "cannot be told apart from that with", 1: "is larger than with"}
    found = []
    for one, other in combinations(masked, 2):
        ratio = answer.ratios(masked[one], masked[other], "rmse")
        found.append(f"with {called[one]} RMSE {said[verdict(ratio)]} {called[other]} ({_times(ratio)})")
    if not found:
        return ""
    return f"### One against the other, {ESTIMATORS[estimator]}\n\n{'; '.join(found)}."


def _times(ratios):
    return f"{_ratio(*answer.mean_ratio(ratios))} times"


def _ratio(mean, low, high):
    return f"{mean:.2f}" if np.isnan(low) else f"{mean:.2f} ({low:.2f} to {high:.2f})"


def _lower(ratios):
    return f"lower in {(ratios < 1).sum()} of {ratios.notna().sum()} sequences"


def _lower_of(changes):
    return f"{(changes < 0).sum()} of {len(changes)}"


def _number(count, noun):
    return f"{count} {noun}{'s' * (count != 1)}"
