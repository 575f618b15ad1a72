"""What the commands about a path print: a run's errors and a camera's angles, as JSON's records and as text."""

from thesis_repro.odometry import metrics
from thesis_repro.odometry.refined import boresight

ERRORS = ("rmse_m", "mae_m", "ate_se3_m", "relative_translation_percent", "relative_rotation_deg_per_m")
METRES = ("rmse", "rmse_own", "rmse_others", "rotations", "directions", "ate")


def run(result, sequence, alignment):
    """The record of an `odometry.Result`: errors by name (None without truth and on too short a path), keypoints, time
    and flags."""
    errors = dict.fromkeys(ERRORS)
    if sequence.has_truth:
        values = metrics.errors(result.poses, sequence.poses, alignment).values()
        errors = {name: _number(value) for name, value in zip(ERRORS, values, strict=True)}
    seconds = result.frames.filter(like="_seconds").sum(axis=1)
    return {"sequence": sequence.name, "frames": len(sequence), **errors,
            "mean_keypoints": float(result.frames["detected"].mean()), "ms_per_frame": 1000 * float(seconds.mean()),
            "flagged": {flag: int(count) for flag, count in result.flagged.items()}}


def run_text(record, sequence, speed=None):
    """The record of a run as lines. speed: metres a second, assumed where there is no truth."""
    if sequence.has_truth:
        errors = [f"RMSE            {record['rmse_m']:.6f} m", f"MAE             {record['mae_m']:.6f} m",
                  f"ATE, aligned    {_text(record['ate_se3_m'], '.6f')} m",
                  f"over {metrics.RELATIVE_LENGTH:g} m       {_text(record['relative_translation_percent'], '.3f')} %, "
                  f"{_text(record['relative_rotation_deg_per_m'], '.5f')} degrees a metre"]
    else:
        steps = "1 m a frame" if speed is None else f"{speed:g} m/s"
        errors = [f"no truth to compare with ({sequence.poses_path} does not exist); steps of {steps} are assumed"]
    flags = [f"{flag:16}{count} frame{'s' * (count > 1)}" for flag, count in record["flagged"].items()]
    return "\n".join([f"sequence {record['sequence']}, {record['frames']} frames", *errors,
                      f"mean keypoints  {record['mean_keypoints']:.1f}",
                      f"time a frame    {record['ms_per_frame']:.1f} ms", *flags])


def angles(found, table):
    """The record of `boresight.estimate` and of the table of `boresight.explained`."""
    record = {f"{name}_deg": _number(float(angle)) for name, angle in zip(boresight.ANGLES, found.angles, strict=True)}
    record |= {f"{name}_interval_deg": None if low != low else [float(low), float(high)]
               for name, low, high in zip(boresight.ANGLES, found.low, found.high, strict=True)}
    units = dict.fromkeys(("steps", "others"), "") | dict.fromkeys(METRES, "_m")
    sequences = {row.pop("sequence"): {f"{key}{units.get(key, '_deg')}": _number(value) for key, value in row.items()}
                 for row in table.to_dict("records")}
    return record | {"steps": found.steps, "sequences": sequences}


def angles_text(found, table):
    """The same as lines."""
    lines = [f"{angle:6}{_degrees(found.angles[index], found.low[index], found.high[index])}"
             for index, angle in enumerate(boresight.ANGLES)]
    lines.append(
        f"from {found.steps} steps of sequences {', '.join(table['sequence'])}\n\n"
        "RMSE in metres: as it is, with the sequence's own angles, with those of the others of its recording day;\n"
        "and what is left where rotations alone, or directions of motion alone, are the odometry's. ATE: aligned.\n"
        "Degrees: how much the sideways direction of motion sways on straight steps, to the camera and in the\n"
        f"truth, and by how much the rotations of both part over the first {boresight.FIRST_STEPS} steps.")
    for row in table.to_dict("records"):
        its_angles = (f"{angle} {_degrees(row[angle], row[f'{angle}_low'], row[f'{angle}_high'])}"
                      for angle in boresight.ANGLES)
        others = f", of {row['others']} {row['rmse_others']:.3f}" if row["others"] else ""
        lines.append(
            f"\nsequence {row['sequence']}: {', '.join(its_angles)}\n"
            f"  RMSE {row['rmse']:.3f}, own angles {row['rmse_own']:.3f}{others}; rotations alone "
            f"{row['rotations']:.3f}, directions alone {row['directions']:.3f}; ATE "
            f"{_text(_number(row['ate']), '.3f')}\n  sway: camera {_text(_number(row['camera_sway']), '.2f')}, truth "
            f"{_text(_number(row['truth_sway']), '.2f')}; first steps {row['start']:.2f}")
    return "\n".join(lines)


def _degrees(angle, low, high):
    return "not determined" if angle != angle else f"{angle:+.3f} ({low:+.3f} to {high:+.3f})"


def _number(value):
    return None if value != value else value  # JSON knows no NaN


def _text(value, form):
    return "none (too short or straight)" if value is None else format(value, form)
