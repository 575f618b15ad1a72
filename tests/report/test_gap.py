"""The gap between domains, on made-up scores."""

import pandas as pd

from thesis_repro.report import gap, style

OWN, SHIPPED = "the model of this run", "the model in the package"
VALIDATION, STREETS = "validation images", "KITTI's street scenes"


class Gap:
    """Scores of two models on two domains; the second domain of the first model has no sky."""

    scores = pd.DataFrame(
        [
            (OWN, VALIDATION, 20, 2, 0.6, 0.9),
            (OWN, STREETS, 7, 1, 0.3, float("nan")),
            (SHIPPED, VALIDATION, 20, 2, 0.5, 0.8),
            (SHIPPED, STREETS, 7, 2, 0.4, 0.7),
        ],
        columns=["model", "domain", "images", "classes", "mean_iou", "sky_recall"],
    ).assign(accuracy=0.7)
    classes = pd.DataFrame(
        [
            {
                "model": row.model,
                "domain": row.domain,
                "class": name,
                "id": number,
                "share": 0.5,
                "iou": iou,
            }
            for row in scores.itertuples()
            for name, number, iou in (("road", 7, 0.8), ("sky", 23, 0.7))[: row.classes]
        ]
    )


def test_the_table_shows_each_model_and_domain():
    table = gap.table(Gap).set_index("measure")
    assert list(table) == [
        f"{OWN}: {VALIDATION}",
        f"{OWN}: {STREETS}",
        f"{SHIPPED}: {VALIDATION}",
        f"{SHIPPED}: {STREETS}",
    ]
    scores = table[f"{OWN}: {VALIDATION}"]
    assert scores[["images", "classes present", "mean IoU over these", "IoU: sky"]].tolist() == [
        20,
        2,
        0.6,
        0.7,
    ]
    assert pd.isna(table.loc["IoU: sky", f"{OWN}: {STREETS}"])
    assert table.index.is_unique


def test_the_quality_of_label_maps_is_recorded(tmp_path):
    assert gap.label_map_quality(tmp_path) == []
    style.save_table(
        Gap.scores.assign(used=Gap.scores["model"] == SHIPPED), tmp_path, gap.RECORD, "note"
    )
    rows = gap.label_map_quality(tmp_path)
    assert [
        (row["domain"], row["mean_iou"], row["classes"], row["images"], row["seen"]) for row in rows
    ] == [(VALIDATION, 0.5, 2, 20, False), (STREETS, 0.4, 2, 7, True)]
