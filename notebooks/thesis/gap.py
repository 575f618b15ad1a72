"""The domain gap (Section 4.1), a `domain_gap.Gap`, as a table; the quality of the label maps."""

from pathlib import Path
from typing import Any

import pandas as pd

FRAMES = "the odometry's frames"  # the domain for which masks are made
# a model and a domain with images that are in the model's training data
SEEN = ("the model in the package", "KITTI's street scenes")
RECORD = "quality"  # name of the table in the build folder with the scores of all models
MEASURES = {  # column: name in the table, factor, digits
    "images": ("images", 1, 0),
    "classes": ("classes present", 1, 0),
    "mean_iou": ("mean IoU over these", 1, 3),
    "accuracy": ("pixel accuracy", 1, 3),
    "sky_recall": ("sky found (%)", 100, 1),
}


def table(gap: Any) -> pd.DataFrame:
    """Return one row for each measure and class, one column for each model and domain.

    A cell is empty if the class is absent.
    """
    measures = {}
    for key, (name, factor, digits) in MEASURES.items():
        measures[name] = (factor * gap.scores[key]).round(digits)
    columns = gap.scores["model"] + ": " + gap.scores["domain"]
    rows = pd.DataFrame(measures).set_axis(columns).T
    classes = gap.classes.assign(column=gap.classes["model"] + ": " + gap.classes["domain"])
    ious = classes.pivot(index=["id", "class"], columns="column", values="iou").droplevel("id")
    table = pd.concat([rows, ious.round(3).rename("IoU: {}".format)])
    return table.rename_axis(index="measure", columns=None).reset_index()


def label_map_quality(build: Path) -> list[dict[str, Any]]:
    """Return the scores of the model that the odometry uses, one dict a domain.

    They are read from RECORD in the build folder; [] if notebook 05 measured none. The odometry's
    frames come first if they have true label maps. `seen`: whether some of the domain's images are
    in the model's training data.
    """
    path = build / f"{RECORD}.csv"
    if not path.is_file():
        return []
    used = pd.read_csv(path).query("used")
    used = used.sort_values("domain", key=lambda names: names != FRAMES, kind="stable")
    seen = (used["model"] == SEEN[0]) & (used["domain"] == SEEN[1])
    return used.assign(seen=seen).to_dict("records")
