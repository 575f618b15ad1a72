"""What a run of the odometry gives, as one record for JSON and for the template run.txt.j2."""

from typing import Any

from thesis_repro.data.kitti import Sequence
from thesis_repro.odometry import Result, metrics

# the errors of `metrics.errors`, in its order, with their units
ERRORS = (
    "rmse_m",
    "mae_m",
    "ate_se3_m",
    "relative_translation_percent",
    "relative_rotation_deg_per_100m",
)


def run_record(result: Result, sequence: Sequence) -> dict[str, Any]:
    """Return the errors, keypoints, time and flags of an `odometry.Result`.

    An error that is not determined is None.
    """
    mean_keypoints = 0.0
    detected = result.frames["detected"].dropna()
    if len(detected):  # no frame may have structure
        mean_keypoints = float(detected.mean())
    seconds = result.frames.filter(like="_seconds").sum(axis=1)
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        **_errors(result, sequence),
        "mean_keypoints": mean_keypoints,
        "ms_per_frame": 1000 * float(seconds.mean()),
        "flagged": {flag: int(count) for flag, count in result.flagged.items()},
    }


def _errors(result: Result, sequence: Sequence) -> dict[str, float | None]:
    if not sequence.has_truth:
        return dict.fromkeys(ERRORS)
    values = metrics.errors(result.poses, sequence.poses).values()
    errors: dict[str, float | None] = dict(zip(ERRORS, values, strict=True))
    for name, value in errors.items():
        if value != value:  # NaN
            errors[name] = None
    return errors
