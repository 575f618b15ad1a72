"""What the thesis's own comparison gives (Section 4.2, Tables 4.1 to 4.3), and its findings.

The choice of a width is in `keypoint_study.best_width`; all other comparisons are in
`keypoint_study.comparisons`. A change is Equation 4.1 of means over the repetitions, in percent;
negative is better. `masked` and `baseline` are the runs with masks of each width and with all
keypoints, from `comparisons.of_method`.
`shuffled` are runs with all keypoints, many repetitions. A metric is "rmse" or "mae".
"""

from typing import Any

import numpy as np
import pandas as pd

from keypoint_study import ratios, verdicts
from keypoint_study.best_width import (
    best_widths,
    changes,
    chosen_widths,
    of_chosen_width,
    percent_change,
    stability,
)
from keypoint_study.jobs import Job, repeated
from keypoint_study.report import comparison, findings, style, texts
from thesis import REPORTED, artefacts, map_quality, timing
from thesis.run_settings import Settings
from thesis_repro.running.files import write_text

__all__ = [
    "best_widths",
    "changes",
    "changes_of_repetition",
    "chosen_widths",
    "is_decisive",
    "middle",
    "null_distribution",
    "of_chosen_width",
    "percent_change",
    "reduced_jobs",
    "stability",
    "table_4_1",
    "table_of_change",
]
STUDIES = 4000  # simulated ones
AS_SLAM_SYSTEMS = ("static", "inverse", "static-boundaries")  # masks of published systems
SINGLE = "change (%), one run each"
NULL = "change (%), one run each, if masks did nothing"


def is_decisive(job: Job, tested: int) -> bool:
    """Return whether a run is made in the embedded world, where no conclusion rests on the others.

    Each job is run once, and controls with the refined estimator alone. Section 4.2 compares all
    keypoints, masks of the `tested` width and plainly reduced keypoints: these are repeated. The
    masks that published systems use (AS_SLAM_SYSTEMS) are compared on real frames only.
    """
    if job.method in AS_SLAM_SYSTEMS:
        return False
    if job.method not in ("baseline", "masked", "reduced"):
        return job.repetition == 0 and job.estimator == "refined"
    is_tested = job.method == "masked" and job.dilation_width == tested
    return job.repetition == 0 or is_tested or job.method != "masked"


def reduced_jobs(best: pd.DataFrame, repetitions: int = 1) -> list[Job]:
    """Return jobs that limit the detector to as many keypoints as the best masks leave.

    This is each sequence's mean number of keypoints at its best width (Figure 4.12). best: the
    table of `best_widths`.
    """
    limits = best["mean_keypoints"].round().clip(lower=1)  # OpenCV takes 0 as "no limit"
    jobs = [Job(name, "reduced", max_keypoints=int(limit)) for name, limit in limits.items()]
    return repeated(jobs, ["thesis"], repetitions)


def changes_of_repetition(
    masked: pd.DataFrame, baseline: pd.DataFrame, metric: str, repetition: int = 0
) -> pd.Series:
    """Return the change (%) by the thesis's literal procedure, by sequence.

    All keypoints and each width are run once: only the runs of one repetition are used, also to
    choose the width.
    """
    best = of_chosen_width(masked[masked["repetition"] == repetition])
    return changes(best, baseline[baseline["repetition"] == repetition], metric)


def null_distribution(baseline: pd.DataFrame, widths: int, metric: str) -> pd.DataFrame:
    """Simulate the changes (%) that the thesis's literal procedure reports if masks do nothing.

    Then a run with masks is a run with all keypoints whose matched points are shuffled in another
    way. For each sequence, one of its runs with all keypoints is drawn as the benchmark, and
    another one for each of `widths` widths. The one with the lowest RMSE is the best width, and the
    benchmark beats it in one of widths + 1 studies. Returns STUDIES rows, one column a sequence,
    without those that were run only once. A sequence with fewer than widths + 1 runs has all of
    them drawn, which is the best of fewer widths.
    """
    random = np.random.default_rng(0)
    columns = {}
    for name, runs in baseline.groupby("sequence"):
        if len(runs) < 2:
            continue
        errors, rmse = runs[metric].to_numpy(), runs["rmse"].to_numpy()
        drawn = random.permuted(np.tile(np.arange(len(runs)), (STUDIES, 1)), axis=1)
        benchmark, of_widths = drawn[:, 0], drawn[:, 1 : widths + 1]
        best_column = rmse[of_widths].argmin(axis=1)
        best = of_widths[np.arange(STUDIES), best_column]
        columns[name] = percent_change(errors[best], errors[benchmark])
    return pd.DataFrame(columns)


def middle(values: pd.Series) -> tuple[float, float]:
    """Return the ends of the middle 95 percent of a number of simulated studies."""
    tail = (100 - verdicts.LEVEL) / 200
    return values.quantile(tail), values.quantile(1 - tail)


def table_4_1(masked: pd.DataFrame, reported_as: str) -> pd.DataFrame:
    """Table 4.1: each sequence's best dilation width and mean number of keypoints.

    The last columns have the thesis's numbers; reported_as: how to name them.
    """
    best = best_widths(masked)
    reported = pd.DataFrame(REPORTED["table_4_1"]).set_index("sequence")
    reported = reported.reindex(best.index).astype("Int64")
    columns = {
        "frames": best["frames"],
        "dilation width (pixels)": best["dilation_width"],
        "mean keypoints": best["mean_keypoints"].round().astype(int),
        "failed runs": _failed_of(of_chosen_width(masked)),
        f"width, {reported_as}": reported["dilation_width"],
        f"mean keypoints, {reported_as}": reported["mean_keypoints"],
    }
    return pd.DataFrame(columns).rename_axis("sequence").reset_index()


def table_of_change(
    masked: pd.DataFrame,
    baseline: pd.DataFrame,
    shuffled: pd.DataFrame,
    metric: str,
    reported_as: str,
) -> pd.DataFrame:
    """Tables 4.2 and 4.3: a metric with all keypoints and with the best mask, and Equation 4.1.

    The metric is in metres, Equation 4.1 in percent. The column "one run each" has the thesis's
    literal procedure: one run of all keypoints and of each width (repetition 0), also to choose the
    width. Beside it stands what this procedure gives if masks do nothing (`null_distribution`),
    simulated from `shuffled`.
    The last rows have the sum of the percentages (the thesis's "aggregate"), their mean with
    Student's t interval, and their median.
    """
    best = of_chosen_width(masked)
    number = {"rmse": "table_4_2", "mae": "table_4_3"}[metric]
    by_sequence = {
        "change (%)": changes(best, baseline, metric),
        SINGLE: changes_of_repetition(masked, baseline, metric),
        f"change (%), {reported_as}": pd.Series(REPORTED[f"{number}_{metric}_percent_change"]),
    }
    last_rows = {name: _summary(values) for name, values in by_sequence.items()}
    studies = null_distribution(shuffled, masked["dilation_width"].nunique(), metric)
    if len(studies.columns):
        by_sequence[NULL], last_rows[NULL] = studies.mean(), _summary_of_studies(studies)
    errors = pd.DataFrame(index=sorted(baseline["sequence"].unique()))
    for method, rows in {"all keypoints": baseline, "best mask": best}.items():
        mean = rows.groupby("sequence")[metric].mean()
        errors[f"{metric.upper()}, {method} (m)"] = mean.map("{:.3g}".format).astype(float)
        errors[f"failed runs, {method}"] = _failed_of(rows)
    percent = pd.DataFrame(by_sequence).reindex(errors.index)
    table = errors.join(pd.concat([percent, pd.DataFrame(last_rows)]).round(2), how="right")
    order = [*errors, "change (%)", SINGLE, NULL, f"change (%), {reported_as}"]
    return table.filter(order).rename_axis("sequence").reset_index()


def _failed_of(runs: pd.DataFrame) -> pd.Series:
    """Return the failed runs of each sequence as a text, "2 of 5"."""
    failed = {name: ratios.count_failed(rows) for name, rows in runs.groupby("sequence")}
    return pd.Series(failed, dtype=str)


def _summary(changes: pd.Series) -> dict[str, float]:
    """Return the last rows of Tables 4.2 and 4.3 for one column of changes (%)."""
    low, high = ratios.mean_interval(changes)
    return {
        "sum (the thesis's aggregate)": changes.sum(min_count=1),
        "mean": changes.mean(),
        f"mean, {verdicts.LEVEL} % CI over sequences, from": low,
        f"mean, {verdicts.LEVEL} % CI over sequences, to": high,
        "median": changes.median(),
        "sequences improved": float((changes < 0).sum()),
    }


def _summary_of_studies(studies: pd.DataFrame) -> dict[str, float]:
    """Return the last rows for simulated studies (%), one row a study: means over the studies."""
    means = studies.mean(axis=1)
    low, high = middle(means)
    of_studies = f"mean, middle {verdicts.LEVEL} % of {len(studies)} simulated studies"
    return {
        "sum (the thesis's aggregate)": studies.sum(axis=1).mean(),
        "mean": means.mean(),
        "median": studies.median(axis=1).mean(),
        "sequences improved": (studies < 0).sum(axis=1).mean(),
        f"{of_studies}, from": low,
        f"{of_studies}, to": high,
    }


# Notebook 08: notes, and what the gallery has beside


def notes(settings: Settings, runs: pd.DataFrame, mask_settings: dict[str, Any]) -> tuple[str, str]:
    """Return what stands at the foot of figures and tables, and how to name the thesis's numbers.

    mask_settings: those that are not the thesis's.
    """
    changed = ", ".join(f"{name} {value}" for name, value in mask_settings.items())
    data = artefacts.data_note()
    note = f"{data}; masks: {changed}" if changed else data
    if settings.kitti_is_embedded:
        return note, "thesis, another data set"
    frames = runs.groupby("sequence")["frames"].first()
    lengths = ", ".join(f"{name} ({count} frames)" for name, count in frames.items())
    return f"{note}; {lengths}", "thesis, complete KITTI sequences"


def save_beside(
    settings: Settings,
    runs: pd.DataFrame,
    compared: pd.DataFrame,
    stages: pd.DataFrame,
    note: str,
) -> None:
    """Save what the gallery has beside chapter 4: three tables, and the findings.

    compared: `comparisons_of` the runs. stages: of `timing.of_run`.
    """
    pairs = comparison.table_of_ratios(comparison.all_of(compared))
    artefacts.save_table(pairs, "comparison", note=note)
    artefacts.save_table(comparison.table_of_widths(runs).content, "widths", note=note)
    timed_on = f"{note}; {timing.told(stages)}"
    artefacts.save_table(timing.table_of_stages(stages), "budget", note=timed_on)
    quality = map_quality.label_map_quality(settings.build).round(3)
    quality = quality.filter(["domain", "images", "classes", "mean_iou", "seen"])
    more = texts.render(
        "findings_of_thesis.md.j2",
        label_maps=[style.markdown(table) for table in (quality,) if len(table)],
    )
    text = findings.findings_of(runs, compared, note, settings.kitti_is_embedded, more)
    write_text(settings.figures / "findings.md", text)
