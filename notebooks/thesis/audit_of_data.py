"""Measure the rows of the audit that notebook 09 does not show live.

Rows of notebooks that were not run have no numbers.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from cv2 import INTER_NEAREST, resize

from thesis import artefacts, audit_of_tables, audit_runs, domain_gap, earlier, timing
from thesis.audit import measurement, ratio
from thesis.audit_of_tables import TIME_OF_NARROW, TIME_TOGETHER, TIME_TYPICAL, WIDTHS
from thesis.settings import Settings
from thesis_repro.data.cityscapes import ID, read_label_map
from thesis_repro.data.kitti import TRUE_LABELS
from thesis_repro.data.sequence import Sequence

SMALL = [ID[name] for name in ("pole", "traffic light", "traffic sign", "person")]
SHADOW = (
    0.7  # of the median road of a frame; darker road counts as shadow, in rendered frames rightly
)
UNMASKED = "all keypoints"  # in the table of times
FRAMES = 12  # of each sequence whose label maps are compared with the exact ones


def measurements_of_run(
    settings: Settings, drives: list[Sequence], repetitions: int, pairs: int
) -> list[dict[str, Any]]:
    """Return the measurements of all rows that are not live, for `audit.audit_table`.

    drives: the sequences of the ablations. repetitions: of each ablation. pairs: of frames of each
    sequence whose boundaries are measured. Writes ablations.csv.
    """
    labels = earlier.label_maps()
    ablated = audit_runs.run_ablations(
        drives, labels, settings.build / "audit", repetitions, settings.jobs
    )
    artefacts.write_text("ablations.csv", ablated.to_csv(index=False))
    return [
        *audit_of_tables.of_shares(boundaries(drives, labels, pairs)),
        *audit_of_tables.of_ablations(ablated),
        *audit_of_tables.of_shares(right_pixels(settings, drives, labels)),
        *of_earlier_notebooks(settings, len(drives)),
    ]


def boundaries(drives: list[Sequence], labels: Path, pairs: int) -> pd.DataFrame:
    """Measure the boundaries of label maps; returns one row a frame (see `audit_runs.boundaries`).

    Thin objects are those of the exact label maps, if there are any.
    """
    rows = []
    for drive in drives:
        own, exact = labels / drive.name, drive.folder / TRUE_LABELS
        for index in range(0, len(drive), max(1, len(drive) // pairs)):
            name = drive.frame_paths[index].name
            thin_map = read_label_map((exact if exact.is_dir() else own) / name)
            shares = audit_runs.boundaries(read_label_map(own / name), drive.size)
            shares |= audit_runs.thin_boundaries(thin_map, drive.size)
            rows.append({"sequence": drive.name, "frame": index} | shares)
    return pd.DataFrame(rows)


def right_pixels(settings: Settings, drives: list[Sequence], labels: Path) -> pd.DataFrame:
    """Compare label maps with the exact ones, if there are any; returns one row a frame."""
    rows = []
    for drive in drives:
        whole = Sequence(settings.kitti, drive.name).subset(settings.sizes.frames).subset(FRAMES)
        true_folder = drive.folder / TRUE_LABELS
        for index, name in enumerate(whole.label_names if true_folder.is_dir() else ()):
            predicted = read_label_map(labels / drive.name / name)
            shares = right_shares(predicted, read_label_map(true_folder / name), whole.frame(index))
            rows.append({"sequence": drive.name, "frame": index} | shares)
    return pd.DataFrame(rows)


def right_shares(predicted: np.ndarray, exact: np.ndarray, frame: np.ndarray) -> dict[str, float]:
    """Return the shares (%) of right pixels in pairs of areas: {area: share}.

    rim: within a tenth of the height from the frame's edges; inside. small: SMALL things; large:
    all others. dark: road in shadow; lit. A pair whose first area is empty is left out.
    """
    right = resize(predicted, exact.shape[::-1], interpolation=INTER_NEAREST) == exact
    margin = exact.shape[0] // 10
    rim = np.ones(exact.shape, bool)
    rim[margin:-margin, margin:-margin] = False
    small, road = np.isin(exact, SMALL), exact == ID["road"]
    dark = road & (frame < SHADOW * np.median(frame[road]))
    shares: dict[str, float] = {}
    for name, area, other, rest in (
        ("rim", rim, "inside", ~rim),
        ("small", small, "large", ~small),
        ("dark", dark, "lit", road & ~dark),
    ):
        if area.any():
            shares |= {name: 100 * right[area].mean(), other: 100 * right[rest].mean()}
    return shares


def of_earlier_notebooks(settings: Settings, count: int) -> list[dict[str, Any]]:
    """Return the rows of the tables that notebooks 05, 06 and 08 wrote. count: of the sequences.

    Says which rows have no numbers because a notebook was not run.
    """
    measurements: list[dict[str, Any]] = []
    if (settings.build / "shuffled_runs.csv").is_file():
        measurements += audit_of_tables.of_study(*earlier.results()[:2])
        measurements += of_times(settings)
    else:
        print("notebook 8 was not run, so rows that need its runs have no number")
    path = settings.build / "found_again.csv"
    found_again = pd.read_csv(path) if path.is_file() else pd.DataFrame()
    text = "keypoints not found again in the next frame"
    for _, kind, _, share in found_again.itertuples():
        measurements.append(measurement("73", text, share, "%", metric=kind))
    quality = domain_gap.label_map_quality(settings.build)
    for row in quality[quality["domain"] == domain_gap.DRIVES].itertuples() if len(quality) else ():
        recall, frames = 100 * row.sky_recall, round(row.images / count)
        measurements.append(measurement("46", "recall of the sky", recall, "%", frames=frames))
    return measurements


def of_times(settings: Settings) -> list[dict[str, Any]]:
    """Return rows 16 and 47, from the times that notebook 08 shows."""
    seconds, stages = (timing.times(settings, name) for name in ("seconds", "budget"))
    of_each = {name: timing.time_savings(rows) for name, rows in seconds.groupby("sequence")}
    timed_on: dict[str, Any] = {"data": timing.told(seconds)}
    measurements = []
    for place, (threads, saved) in enumerate(timing.time_savings(seconds).items()):
        on = f", {threads}" if place else ""  # first on one thread
        savings = pd.DataFrame({name: each[threads] for name, each in of_each.items()})
        over_all = 1 + savings / 100  # one row a width
        narrow = over_all.iloc[0] / over_all.iloc[-1]
        typical = over_all.reindex(WIDTHS).mean()
        measurements += [
            measurement("47", TIME_TOGETHER + on, saved.reindex(WIDTHS).mean(), "%", **timed_on),
            ratio("47", TIME_TYPICAL + on, typical, **timed_on),
            ratio("47", TIME_OF_NARROW + on, narrow, **timed_on),
        ]
    totals = stages.groupby("method")["milliseconds"].sum()
    whole = totals.drop(UNMASKED) / totals[UNMASKED]
    timed_on = {"data": timing.told(stages)}
    text = "whole frame with masks and network over all keypoints"
    measurements.append(measurement("16", text, whole, "ratio", **timed_on))
    return measurements
