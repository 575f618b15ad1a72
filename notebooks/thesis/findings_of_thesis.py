"""What the findings of a run of notebook 8 say beyond those of a study."""

from typing import Any

import pandas as pd

from keypoint_study.report import findings, style, texts
from thesis import artefacts, map_quality
from thesis.settings import Settings
from thesis_repro.running.files import write_text


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


def write(
    settings: Settings,
    runs: pd.DataFrame,
    compared: pd.DataFrame,
    note: str,
) -> str:
    """Write the findings of a run (`findings.findings_of`) beside the figures, and return them.

    compared: `comparisons_of` the runs.
    """
    quality = map_quality.label_map_quality(settings.build).round(3)
    quality = quality.filter(["domain", "images", "classes", "mean_iou", "seen"])
    more = texts.render(
        "findings_of_thesis.md.j2",
        label_maps=[style.markdown(table) for table in (quality,) if len(table)],
    )
    text = findings.findings_of(runs, compared, note, settings.kitti_is_embedded, more)
    write_text(settings.figures / "findings.md", text)
    return text
