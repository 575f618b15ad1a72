"""The table of all choices: streets as units, and one rule for everybody."""

import made_up
import pandas as pd

import choices
from keypoint_study import jobs
from keypoint_study.jobs import ESTIMATORS
from thesis_repro.odometry.estimators import COMPARED


def test_one_standard_counts_streets_and_asks_rule_5_of_every_choice():
    streets = [f"{number:02d}" for number in range(8)]
    widths = {"baseline": [None], "masked": [jobs.CONTROL_WIDTH], "inverse": [jobs.CONTROL_WIDTH]}
    runs = made_up.runs(streets, lambda *_: 1.0, widths, repetitions=4)
    masked, repetition = runs["method"] == "masked", runs["repetition"]
    # half of the runs fail on one street, a quarter on another
    runs.loc[masked & (runs["sequence"] == "03") & (repetition < 2), "lost"] = 1
    runs.loc[masked & (runs["sequence"] == "04") & (repetition < 1), "lost"] = 1
    few_runs = pd.DataFrame(columns=["sequence", "choice", "number", "estimator", "failed"])
    worths = pd.DataFrame(
        {
            "sequence": street,
            "choice": choice,
            "number": 400,
            "split": split,
            "keypoints": 400,
            "rotation": worth,
            "direction": worth * (1 + 0.01 * index),
        }
        for index, street in enumerate(streets)
        for choice, worth in (("masks", 0.5), ("all but the boundaries", 1.0))
        for split in ("fields", "points")
    )
    table = choices.table_of_choices(runs, few_runs, worths).set_index(["streets", "choice"])
    assert {streets for streets, _ in table.index} == {"all 8", "7, without 01"}
    masks, inverse = (table.loc["all 8", name] for name in ("masks", "all but the boundaries"))
    for estimator in COMPARED:
        title = ESTIMATORS[estimator]
        failing = f"streets on which it fails, {title}"
        assert masks[failing].startswith("1 ") and inverse[failing].startswith("0 ")
    rule = "no worse (rule 5)"  # the errors are equal, so only the failures decide
    assert (masks[rule], inverse[rule]) == ("", "yes")
    assert masks["a keypoint tells"] == "less"
    assert inverse["a keypoint tells"] == "as much"
    assert masks["worth, rotation, by fields"].endswith("8 of 8 below 1")
