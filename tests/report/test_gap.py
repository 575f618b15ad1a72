"""The gap between domains, for reading: on scores written by hand."""

import pandas as pd
import pytest

from thesis_repro.report import gap, page, style
from thesis_repro.settings import read_settings
from thesis_repro.study.flicker import EXACT
from thesis_repro.study.gap import Gap

OWN, SHIPPED = "the model of this run", "the model in the package"


@pytest.fixture
def found():
    scores = [{"model": model, "domain": domain, "images": images, "mean_iou": mean_iou, "accuracy": 0.7, "classes": 2,
               "sky_iou": sky, "sky_recall": 0.95, "found": 0.5, "right": 0.25, "chance": 0.125, "dark": 0.1,
               "dark_wrong": 0.4, "lit_wrong": 0.2, "taken_for": "car", "worse": 3, "compared": compared}
              for model, domain, images, mean_iou, sky, compared in (
                  (OWN, "validation images", 20, 0.6, 0.9, 4), (OWN, "KITTI's street scenes", 7, 0.3, float("nan"), 0),
                  (SHIPPED, "validation images", 20, 0.5, 0.8, 4), (SHIPPED, "KITTI's street scenes", 7, 0.4, 0.7, 4))]
    classes = [{"model": row["model"], "domain": row["domain"], "class": name, "id": number, "share": 0.5, "iou": iou,
                "recall": 0.9} for row in scores for name, number, iou in (("road", 7, 0.8), ("sky", 23, 0.7))
               if not (name == "sky" and row["sky_iou"] != row["sky_iou"])]
    return Gap(pd.DataFrame(scores), pd.DataFrame(classes), pd.Series({OWN: 0.05, SHIPPED: 0.03, EXACT: 0.01}))


def test_the_table_has_a_column_for_each_model_and_domain(found):
    table = gap.table(found).set_index("measure")
    assert list(table) == [f"{OWN}: validation images", f"{OWN}: KITTI's street scenes",
                           f"{SHIPPED}: validation images", f"{SHIPPED}: KITTI's street scenes", EXACT]
    own = table[f"{OWN}: validation images"]
    assert own["mean IoU"] == 0.6 and own["true boundaries found (%)"] == 50 and own["IoU: sky"] == 0.7
    assert pd.isna(table.loc["IoU: sky", f"{OWN}: KITTI's street scenes"])
    flicker = table.loc["pixels that flicker, odometry's frames (%)"]
    assert flicker.dropna().tolist() == [5, 3, 1] and flicker[EXACT] == 1
    assert table.index.is_unique and list(table.index).index("IoU: road") < list(table.index).index("IoU: sky")


def test_the_figure_has_a_panel_a_model_and_a_bar_where_there_is_a_class(found):
    figure = gap.figure(found)
    figure.draw_without_rendering()
    assert [axes.get_title() for axes in figure.axes] == [OWN, SHIPPED]
    heights = [[bar.get_height() for bar in axes.patches] for axes in figure.axes]
    assert sorted(height for height in heights[0] if height == height) == [0.7, 0.8, 0.8]
    assert len([height for height in heights[1] if height == height]) == 4


def test_the_claims_are_told_with_their_numbers(found):
    text = gap.claims(found, "a made-up world")
    assert "Data: a made-up world." in text
    assert "Mean IoU: 0.60 on validation images, 0.30 on KITTI's street scenes." in text
    # where there is no sky, nothing is said
    assert "IoU 0.90 with 95 % of it found on validation images; above the mean of the classes everywhere." in text
    assert "40 % against 20 % on validation images, more in 3 of 4 images, most often as car." in text
    assert "5.0 % with the model of this run, 3.0 % with the model in the package, 1.0 % with exact label maps" in text


def test_the_quality_stands_in_captions_of_the_run(found, tmp_path):
    settings = read_settings({"THESIS_REPRO_BUILD": str(tmp_path / "b"), "THESIS_REPRO_FIGURES": str(tmp_path / "f")})
    settings.figures.mkdir(parents=True)
    assert gap.line(settings.build) is None
    (settings.figures / "table_4_1.csv").write_text("sequence,frames\n00,12\n")
    style.save_table(gap.record(found, SHIPPED), settings.build, gap.RECORD, "note")
    said = gap.line(settings.build)
    assert said == ("label maps by the model in the package: mean IoU 0.50 on validation images (20; pixel accuracy "
                    "0.70), 0.40 on KITTI's street scenes (7; pixel accuracy 0.70; some of them were in its training)")
    assert gap.quality(settings.build) == "mean IoU 0.50"  # of the validation images, where there are no frames
    html = page.build(settings).replace("&#39;", "'")
    assert html.count("abel maps by the model in the package: mean IoU 0.50") == 1  # that one table alone is there
    assert "by the model in the package: mean IoU 0.50" in html[:html.index("How to read it")]
