"""Equivalent numbers of keypoints, the sweep over widths, and names that do not touch."""

import itertools

import numpy as np
import pandas as pd

import reasons
import refined_widths
import saturation
from keypoint_study import worth

STREETS = [f"{number:02d}" for number in range(8)]


def angles(numbers, equivalent):
    """Worths of random keypoints whose angles are those of so many independent ones."""
    rows = [
        {
            "sequence": street,
            "choice": "random keypoints",
            "number": number,
            "split": split,
            "keypoints": number or 1900,
            "rotation": 1.0,
            "direction": 1.0,
            "rotation_deg": (1 + index) / np.sqrt(equivalent(number or 1900)),
            "direction_deg": 3 * (1 + index) / np.sqrt(equivalent(number or 1900)),
        }
        for index, street in enumerate(STREETS)
        for number in numbers
        for split in worth.SPLIT
    ]
    return pd.DataFrame(rows)


def test_independent_keypoints_tell_as_much_as_their_number_and_saturated_ones_less():
    numbers = (100, 400, 0)
    for equivalent in (lambda n: n, lambda n: 400 * (n / 400) ** 0.5):
        table = saturation.table(angles(numbers, equivalent))
        assert list(table["drawn"]) == [100, 400, "all"]
        for column in table.columns[3:]:
            told = table[column].str.extract(r"^(\d+) \((\d+)-(\d+)\)$").astype(float)
            expected = [round(equivalent(number)) for number in (100, 400, 1900)]
            assert (told.to_numpy() == np.array(expected)[:, None]).all()
    assert saturation.figure(angles(numbers, lambda n: n)).axes[0].get_xscale() == "log"


def test_a_sweep_has_one_row_a_width():
    rows = []
    for street, width in itertools.product(STREETS, (None, 1, 10)):
        row = {"sequence": street, "dilation_width": width, "estimator": "refined"}
        row |= {"method": "baseline" if width is None else "masked", "mean_keypoints": 1900}
        row |= {"se3": 1.0, "rotation": 1.0, "failed": 0, "lost": 0}
        if width == 1:
            row |= {"rotation": 1.2, "mean_keypoints": 300, "lost": int(street == "03")}
        rows.append(row)
    table = refined_widths.table(pd.DataFrame(rows)).set_index("dilation width (pixels)")
    ratio, failed = table.loc[1, ["rotational RPE, 1 frame", "failed runs"]]
    assert ratio == "1.20 (1.20-1.20), 8 of 8 above 1" and failed == "1 of 8"
    assert table.loc[10, "rotational RPE, 1 frame"].endswith("0 of 8 above 1")


def test_names_beside_points_do_not_touch():
    rows = [
        {
            "sequence": street,
            "choice": choice,
            "number": worth.DECIDING,
            "split": split,
            "keypoints": 400,
            "rotation": value,
            "direction": value,
        }
        for street in STREETS
        for choice, value in zip(reasons.NAMED, (1.8, 1, 0.65, 0.64, 0.3), strict=True)
        for split in worth.SPLIT
    ]
    worths = pd.DataFrame(rows)
    fields = worths[["sequence", "choice"]].assign(fields=100 * worths["rotation"])
    drawing = reasons.figure(fields, worths)
    drawing.draw_without_rendering()
    for panel in drawing.axes:
        boxes = [text.get_window_extent() for text in panel.texts]
        assert len(boxes) == len(reasons.NAMED)
        assert not any(one.overlaps(other) for one, other in itertools.combinations(boxes, 2))
