"""The command line: thesis-repro COMMAND, or python -m thesis_repro COMMAND."""

import json
import os
import sys
from contextlib import redirect_stdout, suppress
from dataclasses import replace
from itertools import combinations
from math import isnan
from pathlib import Path
from typing import Any

from thesis_repro.command.options import MASK_OPTIONS, build_parser
from thesis_repro.errors import InputError, one_line
from thesis_repro.running import program

# options that name an output file: its content
OUTPUT_FILES = {
    "output": "poses in KITTI format",
    "tum": "poses in TUM format",
    "plot": "figure of the paths",
}
PLOTS = (".png", ".svg", ".pdf", ".jpg")  # endings of a figure's name


# The commands, see COMMANDS. Their docstrings are shown by --help. Each imports its libraries
# itself, so that --help is fast.


def synthesize(options: Any) -> None:
    """Write the embedded world, a rendered street, in the layouts of KITTI and Cityscapes."""
    import street_world

    new, total = street_world.write(options.out, **street_world.SIZES[options.profile])
    program.summary(
        f"{options.out}: kitti and cityscapes of the embedded world, profile {options.profile}, "
        f"{total:,} images with their label maps",
        total - new,
    )


def check_data(options: Any) -> int:
    """Check folders of KITTI, Cityscapes or KITTI's street scenes for damage."""
    import opencv_exact  # loads the compiler
    from thesis_repro import checks

    roots = options.kitti, options.cityscapes, options.kitti_semantic
    if not any(roots):
        raise InputError("no folder to check: give --kitti, --cityscapes or --kitti-semantic")
    if opencv_exact.is_compiled() and opencv_exact.reason_for_opencv():
        print(f"tracker: OpenCV's own, because {opencv_exact.reason_for_opencv()}")
    return int(not checks.report(*roots))


def predict(options: Any) -> None:
    """Predict label maps for images or sequences.

    Label maps hold Cityscapes ids as 8-bit PNG, 320x320, named like the frames.
    """
    from thesis_repro.segmentation import quietly

    if options.preprocess and options.scale != 1:
        raise InputError("--preprocess, --scale: give one of them; --preprocess scales, too")
    images = _image_folders(options.images, options.camera, options.calibration)
    _check_outputs(options, options.images)
    with quietly():  # this import takes seconds, so the files are checked first
        from thesis_repro.segmentation import prediction, training
    model = training.load_model(options.model or prediction.SHIPPED)
    lines, reused = [], 0
    for folder, paths, lens in images:
        output = options.folder
        if folder != options.images:  # one of several sequences
            output /= folder.name
        paths = paths[: options.frames]
        new = prediction.write_label_maps(
            model,
            paths,
            output,
            scale=options.scale,
            lens=lens,
            preprocess=options.preprocess,
        )
        reused += len(paths) - new
        lines.append(f"{output}: {len(paths)} label maps")
    program.summary("\n".join(lines), reused)


def masks(options: Any) -> None:
    """Write the keypoint masks of a sequence (appendix A.8).

    Masks are 8-bit PNG images: 255 keeps keypoints, 0 ignores them.
    """
    from thesis_repro import checks
    from thesis_repro.masks.folders import write_masks

    sequence = _sequence(options)
    label_masks = _masks(options, sequence)
    _check_outputs(options, options.labels, sequence.folder)
    program.warn(checks.input_warnings(sequence, [label_masks]))
    write_masks(label_masks, options.folder)
    program.summary(one_line(f"{options.folder}: {len(label_masks)} masks"))


def odometry(options: Any) -> None:
    """Run the visual odometry on one sequence; print its errors, number of keypoints and time."""
    with redirect_stdout(sys.stderr):  # evo prints a line when it first writes its own settings
        import evo.main_ape  # noqa: F401
    from thesis_repro import checks, odometry
    from thesis_repro.odometry.estimators import ESTIMATORS

    if options.plot:
        import keypoint_study.report.paths  # noqa: F401  a missing package is told before the run
    settings = replace(
        odometry.THESIS,
        detector=_detector(options),
        estimator=ESTIMATORS[options.estimator].make,
        max_keypoints=options.max_keypoints,
        scale_gate=options.scale_gate,
    )
    sequence = _sequence(options)
    masks = _masks(options, sequence)
    _check_outputs(options, sequence.poses_path, options.masks, options.labels, sequence.folder)
    program.warn(checks.input_warnings(sequence, filter(None, [masks])))
    result = odometry.run(sequence, settings, masks, description=f"sequence {sequence.name}")
    if options.output:
        result.write_kitti(options.output)
    if options.tum:
        result.write_tum(options.tum)
    _warn_of_run(result, sequence, settings.scale_gate)
    record = _record(result, sequence)
    if options.plot:
        _draw_path(result, sequence, options.plot)
    print(json.dumps(record) if options.json else _text(record, sequence, options.speed))
    for name, path in _output_files(options).items():
        program.log.info(f"{path}: {OUTPUT_FILES[name]}")


def study(options: Any) -> int:
    """Compare your own masks or keypoints with all keypoints and with controls."""
    from keypoint_study import sources
    from keypoint_study.plan import Study
    from thesis_repro.data import kitti, layout
    from thesis_repro.masks import WIDTHS

    if not options.sources:
        raise InputError(
            "nothing to compare: name a folder of label maps with --labels or of masks with --masks, or own "
            "--keypoints"
        )
    kinds = {kind for kind, _, _ in options.sources}
    has_labels = "labels" in kinds
    mask_settings = _mask_settings(options, has_labels)
    if options.widths and not has_labels:
        raise InputError("--widths: only masks from label maps (--labels) have a width")
    if options.invert and "masks" not in kinds:
        raise InputError("--invert: needs --masks DIR")
    widths = {width for listed in options.widths for width in listed}
    if has_labels and mask_settings.has_width and not widths:
        widths = {*WIDTHS}
    names = dict.fromkeys(layout.locate(options.kitti, name).name for name in options.sequences)
    detector = _detector(options)
    planned = Study(
        kitti=options.kitti.absolute(),
        sequences=tuple(names or kitti.sequences(options.kitti)),
        sources=sources.named(options.sources, mask_settings, options.invert, options.ids),
        widths=tuple(sorted(widths)),
        tested=options.controls,
        estimators=tuple(dict.fromkeys(options.estimator)),
        repetitions=options.repetitions,
        frames=options.frames,
        scale_gate=options.scale_gate,
        masked_settings={"detector": detector} if detector else {},
    )
    planned.check()
    _check_outputs(options, *(source.folder for source in planned.sources))
    # this import takes seconds, so the input is checked first
    from keypoint_study.report import study_report

    return study_report.make(planned, options.folder.absolute(), options.jobs, options.dask)


COMMANDS = {
    function.__name__.replace("_", "-"): function
    for function in (synthesize, check_data, predict, masks, odometry, study)
}


# Helpers of several commands


def _warn_of_run(result: Any, sequence: Any, scale_gate: float) -> None:
    """Warn of what a run and its true poses look like if the input was not what it seemed."""
    from thesis_repro import checks

    steps = len(sequence), result.failed_steps, result.dropped_steps
    program.warn(checks.run_warnings(sequence.name, *steps, scale_gate))
    if sequence.has_truth:
        program.warn(checks.inverted_truth(sequence, result.poses))


def _draw_path(result: Any, sequence: Any, file: Path) -> None:
    """Draw the path of a run, beside the true one if there is one."""
    from keypoint_study.report import paths, style
    from thesis_repro.odometry import metrics

    truth, poses = None, result.poses
    if sequence.has_truth:
        truth = sequence.poses
        poses = metrics.shifted(poses, truth)
    with style.applied():
        drawing = paths.figure_of_paths({"estimate": poses}, truth, f"sequence {sequence.name}")
        style.write_figure(drawing, file)


# {error of `metrics.errors`: its name in a record}
RECORD_NAMES = {
    "rmse": "rmse_m",
    "mae": "mae_m",
    "se3": "ate_se3_m",
    "translation_percent": "relative_translation_percent",
    "rotation_deg_per_100m": "relative_rotation_deg_per_100m",
}


def _record(result: Any, sequence: Any) -> dict[str, Any]:
    """Return the errors, keypoints, time and flags of an `odometry.Result`.

    An error that is not determined is None.
    """
    from thesis_repro.odometry import metrics

    errors = metrics.errors(result.poses, sequence.poses) if sequence.has_truth else {}
    known = {name: value for name, value in errors.items() if not isnan(value)}
    detected = result.frames["detected"].dropna()
    seconds = result.frames.filter(like="_seconds").sum(axis=1)
    return {
        "sequence": sequence.name,
        "frames": len(sequence),
        **{name: known.get(error) for error, name in RECORD_NAMES.items()},
        # no frame may have structure
        "mean_keypoints": float(detected.mean()) if len(detected) else 0.0,
        "ms_per_frame": 1000 * float(seconds.mean()),
        "flagged": {flag: int(count) for flag, count in result.flagged.items()},
    }


def _text(record: dict[str, Any], sequence: Any, speed: float | None) -> str:
    """Return what `odometry` prints of a run. speed: assumed without ground truth, m/s."""
    from thesis_repro.odometry.metrics import RELATIVE_LENGTH

    def shown(name: str, form: str) -> str:
        return "none (too short or straight)" if record[name] is None else form % record[name]

    lines = [f"sequence {one_line(sequence.name)}, {len(sequence)} frames"]
    if sequence.has_truth:
        per_100m = shown("relative_rotation_deg_per_100m", "%.3f")
        lines += [
            f"RMSE            {record['rmse_m']:.6f} m",
            f"MAE             {record['mae_m']:.6f} m",
            f"ATE, aligned    {shown('ate_se3_m', '%.6f')} m",
            f"over {RELATIVE_LENGTH:g} m       {shown('relative_translation_percent', '%.3f')} %, "
            f"{per_100m} deg/100 m",
        ]
    else:
        steps = "1 m a frame" if speed is None else f"{speed:g} m/s"
        place = one_line(sequence.poses_path)
        state = "is not used" if sequence.poses_path.exists() else "does not exist"
        lines.append(f"no ground truth to compare with ({place} {state}); assumed steps: {steps}")
    lines += [
        f"mean keypoints  {record['mean_keypoints']:.1f}",
        f"time a frame    {record['ms_per_frame']:.1f} ms",
    ]
    lines += [
        f"flagged         {count} frame{'s' if count > 1 else ''}: {flag}"
        for flag, count in record["flagged"].items()
    ]
    return "\n".join(lines)


def _detector(options: Any) -> Any:
    """The detector that --detector, --spread and --fill choose; None for the thesis's."""
    from thesis_repro.odometry.keypoints import filled, spread

    detector = vars(options).get("detector")
    if options.spread:
        if detector or vars(options).get("max_keypoints", 2000) != 2000:
            raise InputError("--spread N: goes without --max-keypoints and --detector")
        detector = spread(options.spread)
    if vars(options).get("fill"):
        detector = filled(options.fill, detector)
    return detector


def _sequence(options: Any) -> Any:
    from thesis_repro.data.sequence import Sequence

    names = "speed", "fps", "truth", "calibration", "truth_within"
    own = {name: vars(options)[name] for name in names if name in vars(options)}
    sequence = Sequence(options.kitti, options.sequence, options.camera, **own)
    return sequence.subset(options.frames)


def _image_folders(
    root: Path, camera: str | None = None, calibration: Path | None = None
) -> list[tuple[Path, list, Any]]:
    """Return (folder, its images, their camera) for each sequence that a path names.

    The path is a folder of images, a sequence, a KITTI folder or a folder of sequences. Without a
    calibration that can be read, the camera is None. Raises InputError if there are no images.
    """
    from thesis_repro.data import cameras, layout

    folders = [root]
    if root.is_dir() and not layout.has_frames(root):
        parent = layout.sequences_folder(root)
        if not parent.is_dir():
            parent = root
        folders = layout.folders_with_frames(parent) or [root]
    found = []
    for folder in folders:
        files, lens = layout.files(folder, camera), None
        if calibration is not None:
            lens = cameras.read_camera(calibration, files.camera)
        else:
            with suppress(InputError):  # label maps need no calibration
                lens = files.read_camera(files.calibration)
        found.append((folder, files.frames, lens))
    return found


def _mask_settings(options: Any, has_labels: bool) -> Any:
    from thesis_repro.data.label_ids import LABEL_IDS
    from thesis_repro.masks import MaskSettings

    settings = MaskSettings(
        options.boundaries,
        options.symmetric,
        tuple(options.classes),
        options.without_movable,
        options.margin,
        options.keep,
    )
    if not has_labels and (settings, options.ids) != (MaskSettings(), LABEL_IDS):
        raise InputError(
            f"{', '.join(MASK_OPTIONS)}: need --labels DIR, label maps to make masks from"
        )
    return settings


def _masks(options: Any, sequence: Any) -> Any:
    """The masks that --masks or --labels name, or None."""
    from thesis_repro.masks.folders import LabelMasks, MaskFolder

    settings = _mask_settings(options, options.labels)
    ready_made = vars(options).get("masks")
    if bool(options.labels) != (options.dilation is not None or not settings.has_width):
        raise InputError("--labels DIR, --dilation W: give both or neither")
    if options.labels and ready_made:
        raise InputError("--labels DIR, --masks DIR: give only one of them")
    if vars(options).get("invert") and not ready_made:
        raise InputError("--invert: needs --masks DIR")
    if options.labels:
        return LabelMasks(options.labels, sequence, options.dilation, settings, options.ids)
    if ready_made:
        return MaskFolder(ready_made, sequence, options.invert)
    if vars(options).get("fill"):
        raise InputError("--fill N: needs masks to fill, --labels DIR or --masks DIR")
    return None


def _output_files(options: Any) -> dict[str, Path]:
    return {name: vars(options)[name] for name in OUTPUT_FILES if vars(options).get(name)}


def _check_outputs(options: Any, *inputs: Path | None) -> None:
    """Raise InputError, before anything runs, for an output of an unknown kind or among data.

    Data is only read: no output may lie in a folder of it.
    """
    data = [path.resolve() for path in (vars(options).get("kitti"), *inputs) if path]
    outputs = _output_files(options)
    plot = outputs.get("plot")
    if plot and plot.suffix.lower() not in PLOTS:
        raise InputError(f"--plot {plot}: its name must end in {' or '.join(PLOTS)}")
    for (one, path), (other, same) in combinations(outputs.items(), 2):
        if path.resolve() == same.resolve():
            raise InputError(f"--{one}, --{other}: both are {same}; give each a name of its own")
    for path in filter(None, [vars(options).get("folder"), *outputs.values()]):
        for folder in data:
            if path.resolve().is_relative_to(folder):
                raise InputError(
                    f"{path}: lies in {folder}, which is only read; name another place"
                )


def main(arguments: list[str] | None = None) -> int:
    """Run the command in the arguments (default: of this process), and return its exit status."""
    return program.run(lambda: _call(sys.argv[1:] if arguments is None else arguments))


def _call(arguments: list[str]) -> Any:
    environment = Path(sys.argv[0]).resolve().parent.parent
    if (environment / "pyvenv.cfg").is_file() and not environment.samefile(sys.prefix):
        raise InputError(
            f"{sys.argv[0]}: was copied, and would run the code that {sys.prefix} has; run make "
            "clean and make setup in the copy"
        )
    options = build_parser(COMMANDS, arguments).parse_args(arguments)
    os.environ["MPLBACKEND"] = "agg"  # commands draw only into files
    return options.function(options)
