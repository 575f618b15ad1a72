"""The gap between domains (Section 4.1) as a table and a figure, and how good the label maps of a run are.

What is shown is a `segmentation.domain_gap.Gap`.
"""

import numpy as np
import pandas as pd

from thesis_repro.report.style import BLUE, GREEN, ORANGE, new_figure

FRAMES = "the odometry's frames"  # the domain that masks are made on
# where the model in the package has seen some of the images: its card says how good it is on others
SEEN = ("the model in the package", "KITTI's street scenes")
RECORD = "quality"  # a table in the build folder: the scores, and which model's label maps the odometry uses
COLOURS = ((BLUE, ""), (ORANGE, "//"), (GREEN, ".."))  # of the domains
MEASURES = {  # column: what the table calls it, factor, digits
    "images": ("images", 1, 0), "classes": ("classes present", 1, 0), "mean_iou": ("mean IoU over these", 1, 3),
    "accuracy": ("pixel accuracy", 1, 3), "sky_recall": ("sky found (%)", 100, 1),
    "found": ("true boundaries found (%)", 100, 1), "chance": ("found by chance (%)", 100, 1),
    "right": ("predicted boundaries that are true (%)", 100, 1),
    "dark": ("ground that is dark (%)", 100, 1), "dark_wrong": ("dark ground taken for something else (%)", 100, 1),
    "lit_wrong": ("lit ground taken for something else (%)", 100, 1),
}
RARE = 0.0005  # of a domain's pixels; classes below that everywhere are left out of the figure


def table(gap):
    """A row for each measure and class, a column for each model and domain; empty where a class is not there.

    Flicker needs no true label maps. It is measured on the odometry's frames, and stands in a model's first column.
    """
    ids = gap.classes.groupby("class")["id"].first().sort_values()
    order = [name for name, _, _ in MEASURES.values()] + [f"IoU: {name}" for name in ids.index]
    flicker = (100 * gap.flicker).round(2)
    columns = {}
    for row in gap.scores.to_dict("records"):
        column = {name: round(factor * row[key], digits) for key, (name, factor, digits) in MEASURES.items()}
        classes = gap.classes[(gap.classes["model"] == row["model"]) & (gap.classes["domain"] == row["domain"])]
        column |= dict(zip("IoU: " + classes["class"], classes["iou"].round(3)))
        column["pixels that flicker (%)"] = flicker.pop(row["model"]) if row["model"] in flicker else np.nan
        columns[f"{row['model']}: {row['domain']}"] = column
    columns |= {name: {"pixels that flicker (%)": share} for name, share in flicker.items()}  # exact label maps
    return pd.DataFrame(columns).reindex([*order, "pixels that flicker (%)"]).rename_axis("measure").reset_index()


def figure(gap):
    """IoU of each class, a panel a model and a bar a domain; lines stand at the means over classes."""
    shares = gap.classes.groupby("class")["share"].max()
    shown = [name for name in gap.classes.sort_values("id")["class"].unique() if shares[name] >= RARE]
    models, domains = gap.scores["model"].unique(), list(gap.scores["domain"].unique())
    ious = gap.classes.set_index(["model", "domain", "class"])["iou"].sort_index()
    means = gap.scores.set_index(["model", "domain"])["mean_iou"]
    drawn, axes = new_figure(len(models), 1, height=2.1 * len(models) + 0.6, squeeze=False, sharex=True, sharey=True)
    width = 0.8 / len(domains)
    for panel, model in zip(axes[:, 0], models):
        for place, (domain, (color, hatch)) in enumerate(zip(domains, COLOURS)):
            positions = np.arange(len(shown)) + (place - (len(domains) - 1) / 2) * width
            panel.bar(positions, ious[model, domain].reindex(shown), width, color=color, hatch=hatch,
                      edgecolor="white", linewidth=0.3, label=domain)
            panel.axhline(means[model, domain], color=color, linewidth=1, linestyle="--")
        panel.set(title=model, ylabel="IoU", ylim=(0, 1))
        panel.grid(axis="x", visible=False)
    axes[-1, 0].set_xticks(range(len(shown)), shown, rotation=45, ha="right", rotation_mode="anchor", fontsize=8)
    drawn.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(domains),
                 title="dashed: the mean over classes", title_fontsize=8)
    return drawn


def record(gap, used):
    """The scores as a table to be kept in the build folder (RECORD); used: name of the model that the odometry uses."""
    return gap.scores.assign(used=gap.scores["model"] == used)


def label_map_quality(build):
    """How good the label maps of a run are, from its build folder: a list of dicts, one a domain.

    model, domain, mean_iou, classes, images, accuracy, and `seen`: whether some images were in the model's training.
    The domain that masks are made on comes first where it has true label maps. Empty where nothing was measured.
    """
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return []
    scores = pd.read_csv(path)
    scores = scores[scores["used"]].sort_values("domain", key=lambda names: names != FRAMES, kind="stable")
    columns = ["model", "domain", "mean_iou", "classes", "images", "accuracy"]
    return [row | {"seen": (row["model"], row["domain"]) == SEEN} for row in scores[columns].to_dict("records")]


def line(build):
    """One line on how good the label maps of a run are; None where nothing was measured."""
    rows = label_map_quality(build)
    return f"label maps by {rows[0]['model']}: " + ", ".join(map(_mean_iou, rows)) if rows else None


def quality(build):
    """The same for the first domain of `label_map_quality` alone, for verdicts."""
    rows = label_map_quality(build)
    return _mean_iou(rows[0]) if rows else None


def _mean_iou(row):
    return (f"mean IoU {row['mean_iou']:.2f} over {row['classes']} classes on {row['images']} images of "
            f"{row['domain']}{' (some of them were in its training)' * row['seen']}")
