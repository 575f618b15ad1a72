"""Masks against the quality of their label maps, for the evidence on real frames.

They are compared by ratios of errors over the mean IoU.
"""

import re

import pandas as pd

from keypoint_study import compare
from keypoint_study.report import style, texts
from thesis.settings import ROOT

CARD = ROOT / "thesis_repro/segmentation/weights/README.md"  # of the model in the package
REAL, RENDERED = "real frames", "embedded world (rendered)"
ALL_KEYPOINTS, EXACT = compare.METHODS["baseline"], compare.METHODS["true-labels"]
PACKAGE = "the model in the package"
# names of known folders of label maps; others have the folder's
NAMES = {
    "labels_espnetv2": "ESPNetv2, trained on Cityscapes",
    "labels_version_0_6": "an earlier model of the package (0.6)",
}
# mean IoU that the data at hand cannot give, by folder of label maps. Those of the earlier model
# are made by `predict --model` with streets.keras as it was in git before commit 2db64f9.
MEASURED_ELSEWHERE = {
    "labels_espnetv2": (
        0.43,
        "48 KITTI label maps that are not at hand, 11 classes, from colour (README of the data)",
    ),
    "labels_version_0_6": (0.38, "KITTI's 7 pairs held out, 11 classes, from gray (its card)"),
}
RATIO = r"([\d.]+)(?: \([^)]*?([\d.]+)-([\d.]+)\))?"  # "1.09 (95 % CI 0.98-1.32)" or "1.09"


def table(runs, other_runs):
    """Return the ratios of errors with masks from several label maps, refined estimator.

    The table has one row a source and comparison. runs: with the model in the package. other_runs:
    {source: runs with masks from its label maps}, which may cover fewer sequences; masks of the
    package are then also compared on these alone. The last rows come from figures/comparison.csv,
    the embedded world.
    """
    baseline = compare.of_method(runs, "baseline", "refined")
    masked = compare.of_method(runs, "masked", "refined")
    quality = {PACKAGE: _on_card(), **MEASURED_ELSEWHERE}
    rows = [_row(PACKAGE, masked, baseline, quality)]
    for name, others in other_runs.items():
        same = masked[masked["sequence"].isin(others["sequence"])]
        rows += [
            _row(PACKAGE, same, baseline, quality),
            _row(name, others, baseline, quality),
            _row(name, others, same, quality, f"masks of {PACKAGE}"),
        ]
    return pd.DataFrame(rows + _of_embedded_world()).drop_duplicates()


def _row(name, rows, reference, quality, over=ALL_KEYPOINTS):
    ratios = {
        label: texts.ratio(compare.typical_ratio(compare.ratios(rows, reference, metric)))
        for metric, label in compare.JUDGING_METRICS.items()
    }
    mean_iou, where = quality.get(name, (float("nan"), "not known"))
    return {
        "label maps": NAMES.get(name, name),
        "mean IoU": mean_iou,
        "mean IoU from": where,
        "odometry": REAL,
        "sequences": ", ".join(sorted(rows["sequence"].unique())),
        "over": over,
        **ratios,
        "failed runs": compare.count_failed(rows),
    }


def _on_card():
    """Return the mean IoU of the model in the package on KITTI's pairs held out, from its card."""
    card = CARD.read_text(encoding="utf-8")
    pattern = r"\*\*Quality on (KITTI's .*?)\*\*.*?mean IoU \*\*([\d.]+)\*\*"
    pairs, mean_iou = re.search(pattern, card, re.DOTALL).groups()
    return float(mean_iou), f"{pairs}, 11 classes, from gray (model card)"


def _of_embedded_world():
    """Return the rows of the embedded world: its own network and its exact label maps."""
    ratios = pd.read_csv(ROOT / "figures" / "comparison.csv")
    refined = ratios["estimator"] == "refined estimator"
    ratios = ratios[refined & (ratios["over"] == ALL_KEYPOINTS)].set_index("keypoints")
    quality = pd.read_csv(ROOT / "figures" / "domain_gap.csv", index_col="measure")
    trained = float(
        quality.loc["mean IoU over these", "the model of this run: the odometry's frames"]
    )
    masked = ratios[ratios.index.str.startswith(compare.METHODS["masked"])].iloc[0]
    sources = {
        "a network trained for minutes": (trained, "its own frames, 12 classes", masked),
        EXACT: (1.0, "exact", ratios.loc[EXACT]),
    }
    return [
        {
            "label maps": name,
            "mean IoU": mean_iou,
            "mean IoU from": where,
            "odometry": RENDERED,
            "sequences": f"{row['sequences']} rendered drives",
            "over": ALL_KEYPOINTS,
            **{label: row[label] for label in compare.JUDGING_METRICS.values()},
            "failed runs": row["failed runs"],
        }
        for name, (mean_iou, where, row) in sources.items()
    ]


def figure(table):
    """Draw the ratios to all keypoints, one row a source of label maps, one panel a judging metric.

    The mean IoU is a text beside the row and no axis, because each was measured on other images.
    table: from `table`.
    """
    rows = table[table["over"] == ALL_KEYPOINTS]
    names = [_label(row) for _, row in rows.iterrows()]
    labels = list(compare.JUDGING_METRICS.values())
    drawing, panels = style.new_figure(
        1, len(labels), height=0.9 + 0.42 * len(rows), squeeze=False, sharey=True
    )
    for panel, label in zip(panels[0], labels):
        numbers = rows[label].str.extract(RATIO).astype(float).to_numpy()
        for place, (ratio, low, high) in enumerate(numbers):
            color = style.BLUE
            filling = color if rows["odometry"].iloc[place] == REAL else "white"
            panel.plot([low, high], [place, place], **style.interval_style(color, "|"))
            panel.plot(ratio, place, "o", color=color, markersize=5, markerfacecolor=filling)
        panel.axvline(1, color="black", linewidth=0.8)
        panel.set(title=label, xlabel="ratio to all keypoints")
        panel.grid(axis="y", visible=False)
        style.ratio_axis(panel.xaxis, [1, *numbers.ravel()])
    panels[0, 0].set_yticks(range(len(rows)), names, fontsize=7)
    panels[0, 0].set_ylim(len(rows) - 0.5, -0.5)
    return drawing


def _label(row):
    """Return what stands beside a row: the source, its mean IoU and where, and the sequences."""
    sequences = row["sequences"]
    if row["odometry"] == REAL:
        sequences = f"{1 + sequences.count(',')} streets"
    quality = "not known"
    if pd.notna(row["mean IoU"]):
        where = row["mean IoU from"].partition(",")[0]
        quality = f"{row['mean IoU']:.2f}, {where if where == 'exact' else f'on {where}'}"
    return f"{row['label maps']}, {sequences}\nmean IoU {quality}"
