"""What notebook 06 measures of masks: corrected ones, parts of them, and a reader's own."""

from collections.abc import Sequence as Rows
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd

import thesis_repro as tr
from keypoint_study.jobs import CONTROL_WIDTH
from keypoint_study.report import style
from thesis import frames
from thesis_repro import masks
from thesis_repro.data import kitti
from thesis_repro.data.cityscapes import read_label_map
from thesis_repro.data.sequence import Sequence
from thesis_repro.odometry import metrics
from thesis_repro.odometry.loop import detect


def row(result: Any, of_frames: Any, drive: Sequence) -> dict[str, float]:
    """Return a row of a table: the masks of a run over a drive, its keypoints and errors."""
    covered = [masks.coverage(of_frames[number]) for number in range(0, len(drive), 5)]
    return {
        "coverage (%)": 100 * np.mean(covered),
        "keypoints": result.frames["detected"].mean(),
        "aligned ATE (m)": metrics.ate(result.poses, drive.poses, "se3"),
        "rotation error (°/frame)": metrics.step_errors(result.poses, drive.poses)["rotation"],
    }


def table_of_runs(drive: Sequence, runs: dict[str, tuple[Any, Any]]) -> pd.DataFrame:
    """Run a drive with each (settings, masks), and return a row for each run."""
    results = tr.run_many(drive, runs)
    rows = {text: row(result, runs[text][1], drive) for text, result in results.items()}
    return pd.DataFrame(rows).T


def counts(drive: Sequence, labels: Path, numbers: Rows[int], *how: Any) -> dict[str, float]:
    """Return what masks have on average over frames: coverage, keypoints, true boundaries.

    labels: folder of their label maps. how: width and settings, as in `keypoint_mask`. The last two
    numbers need true label maps.
    """
    exact, rows = drive.folder / kitti.TRUE_LABELS, []
    for number in numbers:
        name = drive.label_names[number]
        made = tr.keypoint_mask(read_label_map(labels / name), drive.size, *how)
        found = detect(drive.frame(number), tr.THESIS, made)
        count = {"coverage (%)": 100 * masks.coverage(made), "keypoints": len(found)}
        if exact.is_dir():
            true = read_label_map(exact / name)
            perfect = tr.keypoint_mask(true, drive.size, *how)
            count["true boundaries kept (%)"] = 100 * masks.boundaries_found(made, true)
            count["of true label maps (%)"] = 100 * masks.boundaries_found(perfect, true)
        rows.append(count)
    return dict(pd.DataFrame(rows).mean())


def parts(drive: Sequence, labels: Path) -> dict[str, np.ndarray]:
    """Return parts of the thesis's masks of a drive: {what they are: (n, height, width) uint8}.

    With true label maps, a mask is divided into what lies near a true boundary and what does not.
    """
    predicted = np.array(tr.LabelMasks(labels, drive, CONTROL_WIDTH))
    kinds = {"all keypoints": np.full_like(predicted, 255), "predicted label maps": predicted}
    exact = drive.folder / kitti.TRUE_LABELS
    if exact.is_dir():
        true = np.array(tr.LabelMasks(exact, drive, CONTROL_WIDTH))
        kinds["of these, near true boundaries"] = np.where(true > 0, predicted, 0)
        kinds["of these, invented"] = np.where(true > 0, 0, predicted)
        kinds |= {"true label maps": true, "true and predicted ones": np.maximum(predicted, true)}
    return kinds


def overview(
    frame: np.ndarray, label_map: np.ndarray, source: str, street: str, width: int
) -> plt.Figure:
    """Draw the README's picture: all keypoints, a label map, those on its mask, 200 spread ones.

    source: whose label map it is. street: "real" or "rendered". width: of the dilation, pixels.
    """
    mask = tr.keypoint_mask(label_map, frame.shape, width)
    light = np.where(mask > 0, frame, frame // 3)
    every, on_it = detect(frame, tr.THESIS), detect(frame, tr.THESIS, mask)
    few = tr.spread(200)(frame)
    shown: dict[str, Any] = {f"{street} street: all {len(every)} keypoints": (frame, every)}
    shown[source] = style.label_colors(label_map, frame)
    shown[f"{len(on_it)} on the mask, the widened boundaries (light)"] = light, on_it
    shown[f"{len(few)} spread over the frame"] = frame, few
    return frames.pictures(frame, shown, columns=2, label_maps=[label_map])
