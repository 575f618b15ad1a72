"""The gap between domains, for reading: a table, a figure, Section 4.1's claims in words, and one line for captions.

What is shown is a `study.gap.Gap`.
"""

import numpy as np
import pandas as pd

from thesis_repro.report.style import BLUE, GREEN, ORANGE, new_figure
from thesis_repro.segmentation import errors
from thesis_repro.study.flicker import EXACT

FRAMES = "the odometry's frames"  # the domain that masks are made on
# where the model in the package has seen some of the images: its card says how good it is on others
SEEN = ("the model in the package", "KITTI's street scenes")
RECORD = "quality"  # a table in the build folder: the scores, and which model's label maps the odometry uses
COLOURS = ((BLUE, ""), (ORANGE, "//"), (GREEN, ".."))  # of the domains
MEASURES = {
    "images": ("images", 1, 0), "mean_iou": ("mean IoU", 1, 3), "accuracy": ("pixel accuracy", 1, 3),
    "found": ("true boundaries found (%)", 100, 1), "chance": ("found by chance (%)", 100, 1),
    "right": ("predicted boundaries that are true (%)", 100, 1),
    "dark": ("ground that is dark (%)", 100, 1), "dark_wrong": ("dark ground taken for something else (%)", 100, 1),
    "lit_wrong": ("lit ground taken for something else (%)", 100, 1),
}
RARE = 0.0005  # of a domain's pixels; classes below that everywhere are left out of the figure


def table(gap):
    """A row for each measure and class, a column for each model and domain; empty where a class is not there."""
    columns = {}
    for row in gap.scores.to_dict("records"):
        column = {name: round(factor * row[key], digits) for key, (name, factor, digits) in MEASURES.items()}
        some = gap.classes[(gap.classes["model"] == row["model"]) & (gap.classes["domain"] == row["domain"])]
        columns[_heading(row)] = pd.Series(column | dict(zip("IoU: " + some["class"], some["iou"].round(3))))
    order = [name for name, _, _ in MEASURES.values()]
    order += ["IoU: " + name for name in gap.classes.sort_values("id")["class"].unique()]
    shown = pd.DataFrame(columns).reindex(order)
    if len(gap.flicker):
        changes = (100 * gap.flicker).round(2)
        # flicker needs no true label maps, and is measured on the odometry's frames alone
        shown.loc["pixels that flicker, odometry's frames (%)"] = [
            changes[row["model"]] if first else np.nan
            for row, first in zip(gap.scores.to_dict("records"), ~gap.scores["model"].duplicated())]
        if EXACT in changes:
            shown[EXACT] = np.nan
            shown.loc[shown.index[-1], EXACT] = changes[EXACT]
    return shown.rename_axis("measure").reset_index()


def _heading(row):
    return f"{row['model']}: {row['domain']}"


def figure(gap):
    """IoU of each class, a panel a model and a bar a domain; lines stand at the means over classes."""
    shares = gap.classes.groupby("class")["share"].max()
    shown = [name for name in gap.classes.sort_values("id")["class"].unique() if shares[name] >= RARE]
    models, domains = gap.scores["model"].unique(), list(gap.scores["domain"].unique())
    drawn, axes = new_figure(len(models), 1, height=2.1 * len(models) + 0.6, squeeze=False, sharex=True, sharey=True)
    width = 0.8 / len(domains)
    for panel, model in zip(axes[:, 0], models):
        for place, (domain, (color, hatch)) in enumerate(zip(domains, COLOURS)):
            where = (gap.classes["model"] == model) & (gap.classes["domain"] == domain)
            ious = gap.classes[where].set_index("class")["iou"].reindex(shown)
            positions = np.arange(len(shown)) + (place - (len(domains) - 1) / 2) * width
            panel.bar(positions, ious, width, color=color, hatch=hatch, edgecolor="white", linewidth=0.3, label=domain)
            mean = gap.scores[(gap.scores["model"] == model) & (gap.scores["domain"] == domain)]["mean_iou"].iloc[0]
            panel.axhline(mean, color=color, linewidth=1, linestyle="--")
        panel.set(title=model, ylabel="IoU", ylim=(0, 1))
        panel.grid(axis="x", visible=False)
    axes[-1, 0].set_xticks(range(len(shown)), shown, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
    drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(domains),
                 title="dashed: the mean over classes", title_fontsize=8)
    return drawn


def claims(gap, data):
    """A Markdown text on what the numbers say of Section 4.1's claims: other domains, sky, shadows; data: one line."""
    parts = [f"Data: {data}. The thesis says of its label maps of KITTI that they are slightly worse than those of "
             "Cityscapes, that large parts of open sky are not found, and that shadows are taken for other classes."]
    for model, some in gap.scores.groupby("model", sort=False):
        parts.append(" ".join((f"**{model[0].upper()}{model[1:]}.**", _domains(some), _sky(some), _shadows(some))))
    if EXACT in gap.flicker:
        parts.append("**Flicker.** " + ", ".join(f"{100 * share:.1f} % with {name}"
                                                 for name, share in gap.flicker.items())
                     + " of the pixels change their class from frame to frame after the motion is taken out.")
    return "\n\n".join(parts) + "\n"


def _domains(some):
    return "Mean IoU: " + ", ".join(f"{row.mean_iou:.2f} on {row.domain}" for row in some.itertuples()) + "."


def _sky(some):
    there = some[some["sky_iou"].notna()]
    if there.empty:
        return ""
    worse = there["domain"][there["sky_iou"] < there["mean_iou"]]
    return "Sky: " + ", ".join(f"IoU {row.sky_iou:.2f} with {100 * row.sky_recall:.0f} % of it found on {row.domain}"
                               for row in there.itertuples()) + (
        f"; below the mean of the classes on {', '.join(worse)}." if len(worse) else
        "; above the mean of the classes everywhere.")


def _shadows(some):
    said = [f"{100 * row.dark_wrong:.0f} % against {100 * row.lit_wrong:.0f} % on {row.domain}, more in {row.worse} of "
            f"{row.compared} images" + (f", most often as {row.taken_for}" if row.taken_for else "")
            for row in some.itertuples() if row.compared]
    if not said:
        return "No image has enough dark ground to tell about shadows."
    return f"Dark ground is taken for something else, against lit ground: {'; '.join(said)}."


SHADOW = (f"Dark is ground (road, sidewalk, terrain by the true label map) whose gray is below {errors.DARK:g} times "
          f"the median of its class in its image, lit is the rest of it; what lies within {errors.AWAY} pixels of a "
          "true boundary is left out of both.")
BOUNDARY = (f"A boundary is found where a predicted one lies within {errors.NEAR} pixels of 320; by chance says how "
            "much of the whole image lies so near to a predicted boundary.")


def record(gap, used):
    """What captions and findings need (`line`), as a table to be kept in the build folder; used: a model's name."""
    return gap.scores.assign(used=gap.scores["model"] == used)


def line(build):
    """One line on how good the label maps of a run are, from its build folder; None where notebook 5 has not run."""
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return None
    scores = pd.read_csv(path)
    scores = scores[scores["used"]]
    return f"label maps by {scores['model'].iloc[0]}: mean IoU " + ", ".join(
        f"{row.mean_iou:.2f} on {row.domain} ({row.images}; pixel accuracy {row.accuracy:.2f}"
        f"{'; some of them were in its training' * ((row.model, row.domain) == SEEN)})" for row in scores.itertuples())


def quality(build):
    """How good the label maps of a run are, in short, for verdicts; on the odometry's frames where that is known."""
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return None
    scores = pd.read_csv(path)
    scores = scores[scores["used"]].set_index("domain", drop=False)
    judged = scores.loc[FRAMES] if FRAMES in scores.index else scores.iloc[0]
    seen = " on scenes of which some were in its training" if (judged["model"], judged["domain"]) == SEEN else ""
    return f"mean IoU {judged['mean_iou']:.2f}{seen}"
