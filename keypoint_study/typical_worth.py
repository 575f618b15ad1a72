"""What a keypoint of each choice is worth over several streets: its runs, typical values, verdicts.

The measure is in `worth`.
"""

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import jobs, ratios, verdicts
from keypoint_study.jobs import Job, Run
from keypoint_study.methods import DECIDING, METHODS
from keypoint_study.runner import Measure, run_all
from keypoint_study.sources import Source, own_calls
from keypoint_study.verdicts import verdict
from keypoint_study.worth import MOTIONS, ONE_FIT, worth_of
from keypoint_study.worth_check import OVER, factor_off
from thesis_repro.data.sequence import Sequence


def worths_of(
    sequences: Iterable[Sequence],
    sources: Iterable[Source],
    width: int | None,
    folder: Path,
    numbers: Iterable[int] = (DECIDING,),
    *,
    with_controls: bool = True,
    masked_settings: Mapping[str, Any] = {},
    **workers: Any,
) -> pd.DataFrame:
    """Return the table of `worth_of` for the `jobs.worth_jobs` of sources.

    What is in the folder is kept. masked_settings: see `jobs.runs_of`; workers: `runner.run_all`.
    """
    sequences, sources = list(sequences), list(sources)
    listed = jobs.worth_jobs(sequences, sources, width, numbers, with_controls)
    runs = jobs.runs_of(listed, sequences, sources, masked_settings=masked_settings)
    return run_all(runs, folder, WORTH, **workers).table


def _worths(runs: Mapping[Job, Run]) -> dict[Job, pd.DataFrame | str]:
    """Return the worths of runs over one sequence, or the reasons why there are none."""
    keys = {job: _key(job) for job in runs}
    chosen = {keys[job]: (run.settings, run.masks) for job, run in runs.items()}
    calls = {
        keys[job][0]: own_calls(run.brought.folder) for job, run in runs.items() if run.brought
    }
    failed: dict[tuple[str, int], str] = {}
    table = worth_of(next(iter(runs.values())).sequence, chosen, calls, failed=failed)
    made = dict(iter(table.groupby(["choice", "number"], sort=False)))
    return {job: failed.get(keys[job]) or made[keys[job]] for job in runs}


def _key(job: Job) -> tuple[str, int]:
    """Return the choice and number of a job, as the table has them."""
    title = job.source if job.method == "keypoints" else METHODS[job.method].title
    prefix = f"{job.source}: " if job.source and job.method != "keypoints" else ""
    return prefix + title, job.max_keypoints or 0


def _rows(job: Job, path: Path, changed: int, sequence: Sequence) -> list[dict[str, Any]]:
    return pd.read_csv(path, dtype={"sequence": str}).to_dict("records")


WORTH = Measure("worth of keypoints", worth_of, _worths, _rows, needs_truth=False, divided=False)


# Over several streets


def typical_worths(table: pd.DataFrame, new: Collection[str] = ()) -> pd.DataFrame:
    """Return the typical worth of each choice and number over the sequences, and its verdict.

    table: of `worth_of`, of several sequences. new: those on which nothing was chosen.
    One row a choice and number: keypoints, n (sequences), verdict; for each motion and split, such
    as rotation_fields: the typical worth, its interval (_low, _high), and the number of sequences
    with a worth below 1 (_below). off: `worth_check.factor_off`. verdict_of_fit: that of the second
    measure; it decides nothing.
    """
    rows = []
    for (choice, number), chosen in table.groupby(["choice", "number"], sort=False):
        row = {"choice": choice, "number": number, "keypoints": chosen["keypoints"].mean()}
        worths: dict[str, pd.Series] = {}
        for motion in MOTIONS:
            for split, of_split in chosen.groupby("split", sort=False):
                worths[f"{motion}_{split}"] = np.log(of_split[motion])
        of_fit = {name: worths[name] for name in worths if name.endswith(ONE_FIT)}
        of_halves = {name: worths[name] for name in worths if name not in of_fit}
        row |= {
            "n": chosen["sequence"].nunique(),
            "off": (off := factor_off(choice, number)),
            "verdict": _verdict(of_halves, new_disagree(chosen, new), off),
        }
        if of_fit:
            row["verdict_of_fit"] = _verdict(of_fit, off=off)
        for name, logarithms in worths.items():
            numbers = np.exp(ratios.typical_interval(logarithms))
            row |= dict(zip((name, f"{name}_low", f"{name}_high"), numbers, strict=True))
            row[f"{name}_below"] = int((logarithms < 0).sum())
        rows.append(row)
    return pd.DataFrame(rows)


def over(table: pd.DataFrame, choice: str, other: str) -> pd.DataFrame:
    """Return the worths of one choice divided by those of another, as rows of the same table."""
    keys, names = ["sequence", "number", "split"], list(MOTIONS)
    first, second = (table[table["choice"] == name].set_index(keys) for name in (choice, other))
    divided = (first[names] / second[names]).dropna()
    rows = first.loc[divided.index].assign(choice=f"{choice}{OVER}{other}", **divided)
    return rows.reset_index()[list(table)]


def new_disagree(chosen: pd.DataFrame, new: Collection[str]) -> bool:
    """Return whether the new sequences disagree with the others on a choice, by fields."""
    by_fields = chosen[chosen["split"] == "fields"]
    is_new = by_fields["sequence"].isin(list(new))
    logarithms = np.log(by_fields[list(MOTIONS)])
    return any(
        verdicts.disagree(ratios.typical_interval(others)[0], logarithms.loc[is_new, motion])
        for motion, others in logarithms[~is_new].items()
    )


def _verdict(worths: Mapping[str, pd.Series], new_disagree: bool = False, off: float = 1) -> str:
    """Return the verdict on the logarithms of the worths of both motions and splits, by name."""
    fewest = min(map(len, worths.values()))
    intervals = [ratios.typical_interval(each)[1:] for each in worths.values()]
    sides = [ratios.side_of_one(*np.exp(ends)) for ends in intervals]
    narrow = [
        (name.partition("_")[0], *ratios.narrow_interval(np.exp(each)))
        for name, each in worths.items()
    ]
    return verdict(verdicts.WORTH, fewest, sides, narrow, new_disagree=new_disagree, off=off)
