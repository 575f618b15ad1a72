"""The domain gap (Section 4.1), a `segmentation.domain_gap.Gap`, as a table and a figure; the
label maps' quality.
"""

import pandas as pd

from thesis_repro.report.style import BLUE, GREEN, ORANGE, new_figure

FRAMES = "the odometry's frames"  # the domain for which masks are made
# a model and a domain with images that are in the model's training data
SEEN = ("the model in the package", "KITTI's street scenes")
RECORD = "quality"  # name of the table in the build folder with the scores of all models
COLOURS = (BLUE, ORANGE, GREEN)  # of the domains
MEASURES = {  # column: name in the table, factor, digits
    "images": ("images", 1, 0),
    "classes": ("classes present", 1, 0),
    "mean_iou": ("mean IoU over these", 1, 3),
    "accuracy": ("pixel accuracy", 1, 3),
    "sky_recall": ("sky found (%)", 100, 1),
    "dark": ("ground that is dark (%)", 100, 1),
    "dark_wrong": ("dark ground taken for something else (%)", 100, 1),
    "lit_wrong": ("lit ground taken for something else (%)", 100, 1),
}
# of a domain's pixels; the figure leaves out classes with a smaller share in all domains
MIN_SHARE = 0.0005


def table(gap):
    """Return one row for each measure and class, one column for each model and domain; empty if the
    class is absent.

    Flicker is measured on the odometry's frames without label maps. It is in the first column of
    each model.
    """
    scores, classes = (
        rows.assign(column=rows["model"] + ": " + rows["domain"])
        for rows in (gap.scores, gap.classes)
    )
    measures = (
        pd.DataFrame(
            {
                name: (factor * scores[key]).round(digits)
                for key, (name, factor, digits) in MEASURES.items()
            }
        )
        .set_axis(scores["column"])
        .T
    )
    ious = (
        classes.pivot(index=["id", "class"], columns="column", values="iou")
        .droplevel("id")
        .round(3)
    )
    first_columns = dict(zip(scores["model"][::-1], scores["column"][::-1]))
    flicker = (
        (100 * gap.flicker).round(2).rename(first_columns).to_frame("pixels that flicker (%)").T
    )
    table = pd.concat([measures, ious.rename("IoU: {}".format), flicker])
    return table.rename_axis(index="measure", columns=None).reset_index()


def figure(gap):
    """Draw the IoU of each class, one panel a model and one bar a domain. Lines show the means
    over classes.
    """
    models, domains = gap.scores["model"].unique(), list(gap.scores["domain"].unique())
    common = gap.classes[gap.classes.groupby("class")["share"].transform("max") >= MIN_SHARE]
    ious = common.pivot(index=["id", "class"], columns=["model", "domain"], values="iou").droplevel(
        "id"
    )
    drawn, axes = new_figure(
        len(models), 1, height=2.1 * len(models) + 0.6, squeeze=False, sharex=True, sharey=True
    )
    for panel, model in zip(axes[:, 0], models):
        ious[model].reindex(columns=domains).plot.bar(
            ax=panel, width=0.8, color=COLOURS[: len(domains)], legend=False
        )
        for color, mean in zip(COLOURS, gap.scores.loc[gap.scores["model"] == model, "mean_iou"]):
            panel.axhline(mean, color=color, linewidth=1, linestyle="--")
        panel.set(title=model, xlabel="", ylabel="IoU", ylim=(0, 1))
        panel.grid(axis="x", visible=False)
        panel.tick_params(axis="x", labelsize=8, rotation=45)
    drawn.legend(
        *axes[0, 0].get_legend_handles_labels(),
        loc="outside upper center",
        ncols=len(domains),
        title="dashed: the mean over classes",
        title_fontsize=8,
    )
    return drawn


def label_map_quality(build):
    """Return the scores of the model that the odometry uses, one dict a domain, or [] if notebook
    05 measured none.

    They are read from RECORD in the build folder. The odometry's frames come first if they have
    true label maps. `seen`: whether some of the domain's images are in the model's training data.
    """
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return []
    scores = (
        pd.read_csv(path)
        .query("used")
        .sort_values("domain", key=lambda names: names != FRAMES, kind="stable")
    )
    return [
        row | {"seen": (row["model"], row["domain"]) == SEEN} for row in scores.to_dict("records")
    ]
