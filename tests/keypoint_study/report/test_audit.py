"""The audit's rows and the measurements that are joined to them.

Also the gap between domains, and the recorded network.
"""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import write_texts
from keypoint_study.report import style
from thesis import audit, audit_numbers, map_quality, run
from thesis.run_settings import ROOT
from thesis_repro.data.cityscapes import ID
from thesis_repro.running import provenance

FOLDERS = "figures", "figures/kitti_excerpts"


def test_rows_are_numbered_and_every_measurement_has_a_row():
    assert [int(row["row"]) for row in audit.ROWS] == list(range(1, len(audit.ROWS) + 1))
    assert len(audit.ROWS) >= 85
    assert all(
        row[key].strip() for row in audit.ROWS for key in ("where", "does", "right", "switch")
    )
    with pytest.raises(KeyError, match="999"):
        audit.measurement("999", "all", 1)


def test_what_audit_json_calls_measured_has_a_number_in_git():
    tables = [pd.read_csv(ROOT / folder / "audit.csv", dtype=str) for folder in FOLDERS]
    measured = pd.concat(tables).dropna(subset="quantity")
    on_one_thread = measured["quantity"].str.replace(r", \d+ threads$", "", regex=True)
    in_git = {*zip(measured["row"], on_one_thread)}
    named = {(row, text) for row, texts in audit.MEASURED.items() for text in texts.values()}
    assert named == in_git


def test_arithmetic_with_the_thesiss_tables_is_that_of_the_audit_in_git():
    in_git = pd.read_csv(ROOT / "figures/audit.csv", dtype={"row": str}, keep_default_na=False)
    in_git = in_git[in_git["data"] == "the thesis's numbers"]
    made = audit.audit_table(audit_numbers.of_the_thesis())
    made = made[made["data"] == "the thesis's numbers"]
    named = ["row", "quantity", "metric"]
    assert made[named].to_numpy().tolist() == in_git[named].to_numpy().tolist()
    assert made["value"].tolist() == pytest.approx(in_git["value"].astype(float).tolist())
    assert made["value"].iloc[0] == -13.2  # printed in the thesis


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_audit_has_the_times_of_the_budget_beside_it(folder):
    rows = pd.read_csv(ROOT / folder / "audit.csv", dtype={"row": str})
    budget = pd.read_csv(ROOT / folder / "budget.csv", index_col="stage")
    stages = [stage for stage in budget.index if not stage.startswith(("all", "frames"))]
    (whole,) = rows.loc[rows["row"] == "16", "value"]
    sums = budget.loc[stages, ["masked, width 10", "all keypoints"]].sum()
    assert whole == pytest.approx(sums.iloc[0] / sums.iloc[1], rel=2e-3)


def test_ratios_of_runs_in_git_are_those_of_the_audit_in_git():
    runs, shuffled, ablations = (
        write_texts.read_table(f"{write_texts.REAL}{name}")
        for name in ("runs", "shuffled_runs", "ablations")
    )
    measured = [*audit_numbers.of_study(runs, shuffled), *audit_numbers.of_ablations(ablations)]
    made = audit.audit_table(measured).dropna(subset="n")
    in_git = pd.read_csv(ROOT / FOLDERS[1] / "audit.csv", dtype={"row": str}, keep_default_na=False)
    in_git = in_git[in_git["data"] != "the thesis's numbers"]
    named = ["row", "quantity", "metric", "estimator"]
    both = made.merge(in_git, "left", named, suffixes=("", "_in_git"), validate="1:1")
    assert len(both) > 100
    for column in ("value", "low", "high", "n"):
        expected = pd.to_numeric(both[f"{column}_in_git"])
        assert both[column].tolist() == pytest.approx(expected.tolist(), rel=1e-3, nan_ok=True)
    not_run = audit_numbers.of_ablations(ablations[ablations["method"] != "orb"])
    assert "48" not in {line["row"] for line in not_run}


def test_shares_of_pixels_are_means_over_the_sequences_with_their_number_of_frames():
    shares = pd.DataFrame(
        {
            "sequence": ["00", "00", "01"],
            "frame": [0, 5, 0],
            "lost": [10.0, 30.0, 40.0],
            "small": [np.nan, np.nan, 60.0],
            "thin 5/15": np.nan,
        }
    )
    rows = audit_numbers.of_shares(shares)
    assert {(row["quantity"], row["value"], row["n"], row["frames"]) for row in rows} == {
        ("boundary pixels lost", 30, 2, 2),
        ("accuracy on poles, lights, signs and people", 60, 1, 2),
    }


def test_clear_effects_are_ratios_of_errors_whose_intervals_exclude_1():
    measurements = [
        audit.ratio("48", "orb", [0.5, 0.6] * 3, metric="RMSE"),
        audit.ratio("59", "dropout", [0.5, 2, 0.9, 1.1, 0.8, 1.2], metric="RMSE"),
        audit.ratio("70", "vegetation", [0.5, 0.6] * 3, metric="keypoints"),
        audit.ratio("14", "shuffled", [1.5, 1.6] * 3, metric="RMSE"),
    ]
    assert list(audit.clear_effects(audit.audit_table(measurements))["row"]) == ["48"]


def test_right_pixels_are_counted_by_area():
    exact = np.full((20, 60), ID["road"], np.uint8)
    exact[5:10, 20:30] = ID["pole"]
    frame = np.full(exact.shape, 100, np.uint8)
    frame[15:, :30] = 50  # shadow
    predicted = exact.copy()
    predicted[15:, :15] = ID["car"]  # half of the shadow
    predicted[5:10, 20:22] = ID["car"]  # a fifth of the pole
    shares = map_quality.right_shares(predicted, exact, frame)
    assert shares["small"] == 80 and shares["dark"] == 50 and shares["lit"] == 100
    assert shares["large"] == pytest.approx(100 * (1 - 75 / 1150))
    assert shares["inside"] > shares["rim"]
    assert "small" not in map_quality.right_shares(predicted, np.full_like(exact, 7), frame)


def test_boundaries_between_close_ids_are_lost_and_between_distant_ids_found():
    def found(left, right):
        label_map = np.full((320, 320), left, np.uint8)
        label_map[:, 160:] = right
        return map_quality.found_boundaries(label_map, (188, 620), map_quality.EXACT)

    assert found(7, 8) == 0 and found(7, 23) == 100
    assert np.isnan(found(20, 20))


# The gap between domains, on made-up scores

OWN, SHIPPED = "the model of this run", "the model in the package"
VALIDATION, STREETS = "validation images", "KITTI's street scenes"


# of two models on two domains; the second domain of the first model has no sky
SCORES = pd.DataFrame(
    [
        (OWN, VALIDATION, 20, 2, 0.6, 0.9),
        (OWN, STREETS, 7, 1, 0.3, float("nan")),
        (SHIPPED, VALIDATION, 20, 2, 0.5, 0.8),
        (SHIPPED, STREETS, 7, 2, 0.4, 0.7),
    ],
    columns=["model", "domain", "images", "classes", "mean_iou", "sky_recall"],
).assign(accuracy=0.7)
SCORES["IoU: road"] = 0.8
SCORES["IoU: sky"] = [0.7 if row.classes == 2 else float("nan") for row in SCORES.itertuples()]


def test_the_table_shows_each_model_and_domain():
    table = map_quality.table_of_scores(SCORES).set_index("measure")
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
    assert map_quality.label_map_quality(tmp_path).empty
    style.save_table(
        SCORES.assign(used=SCORES["model"] == SHIPPED), tmp_path, map_quality.RECORD, "note"
    )
    rows = map_quality.label_map_quality(tmp_path).to_dict("records")
    assert [
        (row["domain"], row["mean_iou"], row["classes"], row["images"], row["seen"]) for row in rows
    ] == [(VALIDATION, 0.5, 2, 20, False), (STREETS, 0.4, 2, 7, True)]


# A run is told whether its network is the recorded one

RECORDED = run.RECORDED_NETWORK


@pytest.mark.parametrize(
    "network, in_git, named",
    [
        (RECORDED, True, [RECORDED]),
        ("0" * 12, True, [RECORDED, "0" * 12]),
        ("0" * 12, False, []),
        (None, True, []),
    ],
)
def test_the_networks_are_compared(tmp_path, network, in_git, named):
    if network:
        provenance.stage(tmp_path / "labels" / "00", model=network)
    note = run.network_note(SimpleNamespace(build=tmp_path, figures_in_git=in_git))
    assert bool(note) == bool(named) and all(name in note for name in named)
    assert ("XLA_FLAGS" in note) == (len(named) > 1)
