"""Why are keypoints of some choices worth less? What goes along with the worth, street by street.

This was not fixed before the results were known, and choices of one street share keypoints. So it
suggests a reason and does not prove one.
"""

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from keypoint_study import compare, worth
from keypoint_study.report import style, texts
from thesis_repro.odometry import Matches
from thesis_repro.odometry.metrics import MIN_DIRECTED_STEP
from thesis_repro.odometry.refined.fit import near
from thesis_repro.odometry.sharing import SharedCalls
from thesis_repro.running.files import progress

EVERY = 12  # frames
# choices with a name in the figure, few enough for it; the others are plain dots
NAMED = ("spread keypoints", "random keypoints", "exact class boundaries", "random lines", "masks")
LINE = 7  # points from one name to the next
REASONS = {
    "fields": "fields of 42 pixels with a keypoint",
    "height": "standard deviation of the rows (px)",
    "width": "standard deviation of the columns (px)",
    "tracked": "tracked (%)",
    "agree": "near the motion of all keypoints (%)",
    "parallax": "median parallax (px)",
}


def measure(sequences, sources, width) -> pd.DataFrame:
    """Return one row a sequence and choice: means of REASONS over every EVERY-th frame.

    sequences, sources, width: as for `worth.measure`. Parallax is what remains of a keypoint's
    motion without the rotation.
    """
    rows = []
    for sequence in sequences:
        choices, _ = worth.choices(sequence, sources, width, worth.DECIDING)
        shared = SharedCalls()
        lengths = sequence.scales
        for index in progress(range(0, len(sequence) - 1, EVERY), f"why, {sequence.name}"):
            if lengths[index + 1] < MIN_DIRECTED_STEP:
                continue
            random, chosen = worth.tracked(sequence, index, choices, shared, {})
            motion = worth.refined_motion(random, np.arange(len(random.points)))
            for (choice, number), tracks in chosen.items():
                order = np.random.default_rng((0, index)).permutation(len(tracks.points))
                drawn = order[:number]
                if motion is not None and len(drawn):
                    row = {"sequence": sequence.name, "choice": choice}
                    rows.append(row | _reasons(tracks, drawn, motion, sequence.intrinsics[0, 0]))
    return pd.DataFrame(rows).groupby(["sequence", "choice"], sort=False).mean().reset_index()


def _reasons(tracks, drawn, motion, focal):
    points, found = tracks.points[drawn], drawn[tracks.found[drawn]]
    matches = Matches(tracks.current[found], tracks.previous[found], tracks.threshold)
    agrees = near(motion.rotation, motion.translation, matches, tracks.threshold)
    turned = np.column_stack([matches.current, np.ones(len(found))]) @ motion.rotation.T
    moved = turned[:, :2] / turned[:, 2:] - matches.previous
    parallax = focal * np.linalg.norm(moved[agrees], axis=1)
    return {
        "fields": len(np.unique(points // worth.FIELD, axis=0)),
        "height": points[:, 1].std(),
        "width": points[:, 0].std(),
        "tracked": 100 * len(found) / len(drawn),
        "agree": 100 * agrees.sum() / len(drawn),
        "parallax": np.median(parallax) if len(parallax) else np.nan,
    }


def table(reasons, worths) -> pd.DataFrame:
    """Return one row a reason and split: its rank correlation with the worth over the choices.

    reasons: of `measure`. worths: of `worth.measure`. One correlation a sequence, their typical
    value and interval.
    """
    worths = worths[worths["number"] == worth.DECIDING]
    rows = []
    for reason, title in REASONS.items():
        for split, of_split in worths.groupby("split", sort=False):
            row = {"what": title, "split": f"by {split}"}
            both = of_split.merge(reasons, on=["sequence", "choice"])
            for motion in ("direction", "rotation"):
                correlations = [
                    each[motion].corr(each[reason], method="spearman")
                    for _, each in both.groupby("sequence")
                ]
                typical, low, high = map(texts.number, compare.typical_interval(correlations))
                above = int((np.array(correlations) > 0).sum())
                text = f"{typical} ({low} to {high}), {above} of {len(correlations)} above 0"
                row[f"rank correlation with the worth, {motion}"] = text
            rows.append(row)
    return pd.DataFrame(rows)


def figure(reasons, worths) -> Figure:
    """Draw the typical worth of each choice, by fields, over the fields that it occupies."""
    numbers = worth.typical(worths[worths["number"] == worth.DECIDING]).set_index("choice")
    fields = reasons.groupby("choice")["fields"].mean().reindex(numbers.index)
    drawing, panels = style.new_figure(1, 2, sharey=True, height=3.6)
    for panel, motion in zip(panels, ("direction", "rotation"), strict=True):
        values = numbers[f"{motion}_fields"]
        panel.plot(fields, values, "o", color=style.MASKED, markersize=5)
        panel.axhline(1, color="black", linewidth=0.8)
        style.ratio_axis(panel.yaxis, numbers[["direction_fields", "rotation_fields"]].to_numpy())
        panel.set_xlim(fields.min() - 5, 1.25 * fields.max())
        panel.set_title(motion)
        panel.set_xlabel("fields of 42 pixels with one of 400 keypoints")
    panels[0].set_ylabel("typical worth")
    drawing.draw_without_rendering()  # places of the panels
    for panel, motion in zip(panels, ("direction", "rotation"), strict=True):
        _annotate(panel, fields[[*NAMED]], numbers.loc[[*NAMED], f"{motion}_fields"])
    return drawing


def _annotate(panel, x, y):
    """Name points beside them, one name lower if it would touch the one above."""
    points = 72 / panel.figure.dpi
    above = np.inf
    for name in y.sort_values(ascending=False).index:
        place = x[name], y[name]
        height = panel.transData.transform(place)[1] * points
        above = min(height + 2, above - LINE)
        offset = (4, above - height)
        panel.annotate(name, place, offset, textcoords="offset points", fontsize=6)
