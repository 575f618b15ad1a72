"""The command line: thesis-repro COMMAND, or python -m thesis_repro COMMAND."""

import argparse
import json
import os
import shlex
import signal
import sys
import textwrap
from contextlib import suppress
from dataclasses import fields, replace
from functools import partial
from importlib.metadata import version
from pathlib import Path

from thesis_repro import InputError, console, one_line
from thesis_repro.settings import (
    PROFILES,
    SEED,
    check_outside,
    number,
    read_frames,
    read_widths,
    scheduler_address,
)

# options that name an output file: its content, and the endings that its name may have (none given:
# any)
OUTPUT_FILES = {
    "output": ("poses in KITTI format", ()),
    "tum": ("poses in TUM format", ()),
    "plot": ("figure of the paths", (".png", ".svg", ".pdf", ".jpg")),
    "video": ("video", (".webm",)),
}


# The commands. Their docstrings are shown by --help. Each imports its libraries itself, so that
# --help is fast.


def synthesize(options):
    """write the embedded world, a rendered street, in the folder layouts of KITTI and Cityscapes"""
    from thesis_repro import world

    with console.logged(options.out, options.command_line) as run:
        new, total = world.write(options.out, **PROFILES[options.profile].world, seed=SEED)
        run.end(
            f"{options.out}: kitti and cityscapes of the embedded world, profile {options.profile}, "
            f"{total:,} images with their label maps",
            total - new,
        )


def check_data(options):
    """check folders of KITTI, Cityscapes or KITTI's street scenes: their content, damage, and
    what can be run
    """
    from thesis_repro import check

    roots = options.kitti, options.cityscapes, options.kitti_semantic
    if not any(roots):
        raise InputError(
            "no folder to check: give --kitti (make: KITTI=), --cityscapes or --kitti-semantic"
        )
    return 0 if check.report(*roots, options.deep) else 1


def predict(options):
    """predict label maps (Cityscapes ids as 8-bit PNG, 320x320, named like the frames) for
    images or sequences
    """
    from thesis_repro.segmentation import quietly
    from thesis_repro.study import workers

    images = [(folder, paths) for root in options.images for folder, paths in _image_folders(root)]
    # the name of a link, not of what it points to, because `study` looks for this name
    names = [Path(os.path.abspath(folder)).name for folder, _ in images]
    if len(set(names)) < len(names):
        raise InputError("--images: two folders have the same name; use two commands")
    # sequences of a KITTI folder always get subfolders, even if there is only one
    has_subfolders = [folder for folder, _ in images] != options.images[:1]
    sequences = [
        (paths[: options.frames], options.folder / name if has_subfolders else options.folder)
        for name, (_, paths) in zip(names, images)
    ]
    _check_outputs(
        options, *options.images, *(paths[0].parent for paths, _ in sequences), *options.model
    )
    with quietly():  # this import takes seconds, so the files are checked first
        from thesis_repro.segmentation import prediction
    model_files = options.model or [prediction.SHIPPED]
    with console.logged(options.folder, options.command_line) as run:
        if options.dask:
            with workers.open_pool(1, options.dask) as pool:
                new = prediction.spread_label_maps(pool.run, model_files, sequences)
        else:
            model = prediction.load(tuple(model_files))
            new = sum(
                prediction.write_label_maps(model, paths, output) for paths, output in sequences
            )
        total = sum(len(paths) for paths, _ in sequences)
        run.end(
            "\n".join(f"{output}: {len(paths)} label maps" for paths, output in sequences),
            total - new,
        )


def masks(options):
    """write the keypoint masks of a sequence (appendix A.8): 8-bit PNG images, 255 keeps
    keypoints, 0 ignores them
    """
    from thesis_repro.masks import LabelMasks, write_masks

    sequence, settings = _sequence(options), _mask_settings(options)
    if not options.dilation and settings.keep != "static":
        raise InputError("--dilation W: needed for masks from boundaries")
    mask_sets = [
        LabelMasks(options.labels, sequence, width, settings)
        for width in sorted(set().union(*options.dilation or [(1,)]))
    ]
    _check_outputs(options, options.labels, sequence.folder, sequence.frame_paths[0].parent)
    _warn(_print_oddities(sequence, mask_sets))
    for label_masks in mask_sets:
        width = label_masks.dilation_width
        folder = options.folder if len(mask_sets) == 1 else options.folder / f"mask{width}"
        write_masks(label_masks, folder)
        print(f"{folder}: {len(label_masks)} masks{f' of width {width}' * bool(options.dilation)}")


def odometry(options):
    """run the visual odometry on one sequence and print its errors, number of keypoints and time"""
    from thesis_repro import check, kitti, odometry
    from thesis_repro.odometry import metrics
    from thesis_repro.report import texts
    from thesis_repro.trajectories import write_kitti_poses, write_tum

    changes = {
        field.name: vars(options)[field.name]
        for field in fields(odometry.OdometrySettings)
        if vars(options).get(field.name) is not None
    }
    settings = replace(odometry.THESIS, **changes)
    sequence = _sequence(options)
    masks = _masks(options, sequence)
    _check_outputs(
        options,
        sequence.poses_path,
        *kitti.texts_of(sequence.folder, sequence.frame_paths[0].parent),
        options.masks,
        options.labels,
        sequence.folder,
        sequence.frame_paths[0].parent,
    )
    _warn(_print_oddities(sequence, [masks] if masks else []))
    result = odometry.run(sequence, settings, masks, description=f"sequence {sequence.name}")
    if options.output:
        write_kitti_poses(options.output, result.poses)
    if options.tum:
        write_tum(options.tum, result.poses, sequence.times)
    if sequence.has_truth:
        _warn(check.path_oddities(sequence.name, result.poses, sequence.poses))
    _warn(check.step_oddities(sequence.name, result.failed, len(sequence)))
    record = texts.run_record(result, sequence)
    if options.video:
        from thesis_repro.report import video

        video.write_video(options.video, sequence, settings, masks)
    if options.plot:
        from thesis_repro.report import style, trajectories

        truth = sequence.poses if sequence.has_truth else None
        poses = result.poses if truth is None else metrics.shifted(result.poses, truth)
        drawing = trajectories.figure({"estimate": poses}, truth, f"sequence {sequence.name}")
        style.write_figure(drawing, options.plot)
    _print(
        options,
        record,
        "run.txt.j2",
        sequence=sequence,
        speed=options.speed,
        length=metrics.RELATIVE_LENGTH,
    )


def study(options):
    """compare your own label maps or masks with all keypoints and with controls, in tables,
    figures and a page
    """
    from thesis_repro import kitti, results
    from thesis_repro.settings import ALL_WIDTHS, cores
    from thesis_repro.study import sources
    from thesis_repro.study.study import Study

    if not options.sources:
        raise InputError(
            "no masks: name a folder of label maps with --labels, or of masks with --masks"
        )
    kinds = {kind for kind, _ in options.sources}
    has_labels = "labels" in kinds
    if options.widths and not has_labels:
        raise InputError("--widths: only masks from label maps (--labels) have a width")
    if options.invert and "masks" not in kinds:
        raise InputError("--invert: needs --masks DIR")
    # one of any width, if masks have none
    all_widths = (options.controls or 1,) if options.keep == "static" else ALL_WIDTHS
    names = dict.fromkeys(kitti.name_of(options.kitti, name) for name in options.sequences)
    planned = Study(
        options.kitti.absolute(),
        tuple(names or kitti.sequences(options.kitti)),
        sources.named(
            options.sources, options.name, _mask_settings(options, has_labels), options.invert
        ),
        tuple(sorted(set().union(*options.widths or [all_widths] if has_labels else []))),
        options.controls,
        tuple(dict.fromkeys(options.estimator)),
        options.repetitions,
        options.frames,
    )
    planned.check()
    if options.plan:
        from thesis_repro.study import plan

        _print(options, plan.of_study(planned, options.folder), "plan.txt.j2")
        return 0
    folder = options.folder.absolute()
    _check_outputs(options, *(source.folder for source in planned.sources))
    # this import takes seconds, so the input is checked first
    from thesis_repro.report import study

    with console.logged(folder, options.command_line) as run, results.claimed(folder):
        warnings = [
            line for sequence, masks in planned.masks() for line in _print_oddities(sequence, masks)
        ]
        warnings = _warn(warnings)
        summary = planned.run(folder, options.jobs or cores(), options.dask)
        warnings += _warn(planned.path_oddities(summary, folder))
        counts, page = summary.attrs, study.write(planned, summary, folder, warnings)
        failed = f", {counts['failed']:,} failed (see above)" * (counts["failed"] > 0)
        run.end(f"{len(summary):,} runs{failed}; open {page} in a browser", counts["kept"])
    return 1 if failed else 0


def evaluate(options):
    """compare trajectories with the ground truth: the thesis's RMSE and MAE, ATE, RPE, KITTI's
    t_rel and r_rel
    """
    from thesis_repro import check
    from thesis_repro.kitti import true_path
    from thesis_repro.report import style, trajectories

    sequences = trajectories.by_sequence(options.poses, options.kitti, options.sequence)
    if options.plot and len(sequences) > 1:
        raise InputError("--plot: shows only one sequence; name it with --sequence")
    _check_outputs(options, *options.poses)
    rows, matching = [], {"offset": options.t_offset}
    if options.t_max_diff is not None:
        matching["max_difference"] = options.t_max_diff
    for sequence, files in sequences.items():
        truth, times = true_path(options.kitti, sequence)
        _warn(check.truth_oddities(sequence, truth, times))
        paths = {
            name: trajectories.read(file, times, options.frames, **matching)
            for name, file in files.items()
        }
        truth = truth[: options.frames]
        for name, (matched, poses) in paths.items():
            _warn(
                check.path_oddities(
                    name, poses, truth[matched], options.align not in ("sim3", "scale")
                )
            )
        rows += trajectories.evaluate(paths, truth, options.align, sequence)
    if options.plot:
        drawing = trajectories.figure(
            trajectories.aligned(paths, truth, options.align),
            truth,
            f"sequence {sequence}",
            {name: matched for name, (matched, _) in paths.items()},
        )
        style.write_figure(drawing, options.plot)
    rows += list(trajectories.means(rows))
    _print(
        options,
        rows,
        "evaluate.txt.j2",
        alignment=options.align,
        table=trajectories.table(rows, options.align),
    )


def plan(options):
    """estimate the time and disk space of make figures on this machine, without training (takes a
    minute)
    """
    from thesis_repro.settings import read_settings
    from thesis_repro.study import plan

    # the sizes of the thesis, unless make's PROFILE, FRAMES and so on change them
    settings = read_settings(
        {"THESIS_REPRO_PROFILE": "thesis"} | os.environ | {"THESIS_REPRO_KITTI": str(options.kitti)}
    )
    _print(options, plan.of_thesis(options.kitti, settings.sizes, settings.build), "plan.txt.j2")


# Helpers of several commands


def _sequence(options):
    from thesis_repro.kitti import Sequence

    sequence = Sequence(
        options.kitti, options.sequence, options.camera, getattr(options, "speed", None)
    )
    return sequence.subset(options.frames)


def _print_oddities(sequence, mask_sets):
    """Print what masks of a sequence hold, and return warnings of doubtful input."""
    from thesis_repro import check

    warnings = check.oddities(sequence)
    for masks in mask_sets:
        with suppress(InputError):  # a file that cannot be read is reported when it is used
            line, mask_warnings = check.mask_oddities(masks, sequence)
            console.log.info(line)
            warnings += mask_warnings
    return warnings


def _warn(lines):
    """Print warnings, "place: fault", and return them. One fault of several places is one line."""
    places: dict[str, list[str]] = {}
    for line in lines:
        place, _, fault = line.partition(": ")
        places.setdefault(fault, []).append(place)
    merged = [f"{', '.join(names)}: {fault}" for fault, names in places.items()]
    for line in merged:
        console.log.warning(line)
    return merged


def _image_folders(root):
    """Yield (folder, its images) for a folder of images, a sequence, or each sequence of a KITTI
    folder or of a folder of sequences.

    Raises InputError if there are no images, or if frames of a sequence are missing.
    """
    from thesis_repro import files, kitti

    folders = [root]
    if root.is_dir() and not kitti.has_frames(root):
        parent = kitti.folder_of(root)
        folders = kitti.folders_with_frames(parent if parent.is_dir() else root) or [root]
    for folder in folders:
        image_folder = kitti.images_of(folder)
        paths = files.images(image_folder)
        if not paths:
            raise InputError(f"{image_folder}: holds no PNG or JPEG images")
        if image_folder != folder:
            kitti.check_numbering(paths)
        yield folder, paths


def _mask_settings(options, has_labels=True):
    from thesis_repro.masks import MaskSettings

    settings = MaskSettings(
        options.boundaries,
        options.symmetric,
        tuple(options.classes),
        options.without_movable,
        options.margin,
        options.keep,
        options.ids,
    )
    if not has_labels and settings != MaskSettings():
        raise InputError(
            f"{', '.join(MASK_OPTIONS)}: need --labels DIR, label maps to make masks from"
        )
    for name in ("boundaries", "symmetric", "classes", "dilation", "widths"):
        value = vars(options).get(name)
        if settings.keep == "static" and value not in (None, [], vars(MaskSettings).get(name)):
            raise InputError(f"--{name}: --keep static uses no boundaries; leave it out")
    return settings


def _masks(options, sequence):
    """The masks that --masks or --labels name, or None."""
    from thesis_repro.masks import LabelMasks, MaskFolder

    settings = _mask_settings(options, options.labels)
    if bool(options.labels) != (options.dilation is not None or settings.keep == "static"):
        raise InputError("--labels DIR, --dilation W: give both or neither")
    if options.invert and not options.masks:
        raise InputError("--invert: needs --masks DIR")
    if options.labels:
        width = 1 if options.dilation is None else options.dilation
        return LabelMasks(options.labels, sequence, width, settings)
    return MaskFolder(options.masks, sequence, options.invert) if options.masks else None


def _output_files(options):
    return {name: vars(options)[name] for name in OUTPUT_FILES if vars(options).get(name)}


def _check_outputs(options, *inputs):
    """Raise InputError, before anything runs, if an output cannot be written or would overwrite
    or mix with inputs.
    """
    from thesis_repro.files import check_output, is_stream

    data = [path for path in (vars(options).get("kitti"), *inputs) if path]
    # a sequence given alone belongs to the folder above sequences/
    data += [
        above.parent
        for path in data
        for above in path.resolve().parents
        if above.name == "sequences"
    ]
    folder, used = vars(options).get("folder"), set()
    if folder:
        check_outside(f"--output {folder}", folder, data)
        if any(path.resolve().is_relative_to(folder.resolve()) for path in data):
            raise InputError(f"--output {folder}: holds input of this command; name another folder")
    for name, path in _output_files(options).items():
        endings = OUTPUT_FILES[name][1]
        if endings and path.suffix.lower() not in endings:
            raise InputError(f"--{name} {path}: its name must end in {' or '.join(endings)}")
        check_output(path)
        if not is_stream(path):
            check_outside(f"--{name} {path}", path, data)
        if path.resolve() in used:
            raise InputError(f"--{name} {path}: is another output of this command; name another")
        used.add(path.resolve())


def _print(options, record, template, **values):
    """Print a result as JSON or with a template, and name the written files on standard error."""
    from thesis_repro.files import is_stdout, is_stream
    from thesis_repro.report import texts

    text = (
        json.dumps(record)
        if vars(options).get("json")
        else texts.render(template, record=record, **values).rstrip()
    )
    outputs = _output_files(options)
    print(text, file=sys.stderr if any(map(is_stdout, outputs.values())) else None)
    for name, path in outputs.items():
        if not is_stream(path):
            console.log.info(f"{path}: {OUTPUT_FILES[name][0]}")


# The parser


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser with one-line errors, without abbreviated options, and with a check for
    empty paths.
    """

    def __init__(self, **options):
        super().__init__(allow_abbrev=False, **options)
        self.register("type", Path, _path)

    def error(self, message):
        self.exit(2, f"error: {one_line(message)}; see {self.prog} --help\n")


def _path(text):
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


def _setting(read):
    """Let argparse show the InputError of a function that reads an option, instead of "invalid
    value".
    """

    def read_text(text):
        try:
            return read(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(error) from None

    return read_text


# options of several commands
SHARED = {
    "--kitti": dict(
        type=Path,
        metavar="ROOT",
        help="KITTI folder, with sequences/ and poses/, or with raw drives",
    ),
    "--sequence": dict(
        required=True,
        metavar="NN",
        help="00 to 21, or without --kitti a raw drive of KITTI or a folder with your own frames",
    ),
    "--frames": dict(
        type=_setting(read_frames),
        metavar="N|all",
        help="use the first N frames of a sequence, >= 5 (all)",
    ),
    "--camera": dict(
        metavar="image_N",
        help="folder of the frames (image_0, or else image_2, read as gray; in a raw drive image_00, ...)",
    ),
    "--cityscapes": dict(
        type=Path, metavar="ROOT", help="Cityscapes folder (leftImg8bit/, gtFine/ or train/, ...)"
    ),
    "--output": dict(
        type=Path, dest="folder", required=True, metavar="DIR", help="folder for all results"
    ),
    "--plot": dict(
        type=Path, metavar="FILE", help="draw the paths and their errors (.png, .svg, .pdf, .jpg)"
    ),
    "--json": dict(action="store_true", help="print JSON instead of text"),
    "--sequences": dict(
        nargs="+", action="extend", default=[], metavar="NN", help="sequences to run (all in ROOT)"
    ),
    "--invert": dict(
        action="store_true", help="for --masks in which 0 keeps and other values ignore keypoints"
    ),
    "--dask": dict(
        type=_setting(scheduler_address),
        metavar="ADDRESS",
        help="run on the workers of a Dask scheduler, tcp://host:8786, with the same results",
    ),
}
SEQUENCE, REQUIRED = ("--kitti", "--sequence", "--camera", "--frames"), {"required": True}
WIDTHS = dict(type=_setting(read_widths), nargs="+", action="extend", metavar="W")
MASK_OPTIONS = {
    "--boundaries": dict(
        metavar="canny|exact",
        default="canny",
        help="edges by Canny or all changes of class (canny)",
    ),
    "--symmetric": dict(
        action="store_true", help="centre masks on boundaries; the thesis's are half a pixel off"
    ),
    "--classes": dict(
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="only boundaries of these classes",
    ),
    "--without-movable": dict(
        type=int,
        nargs="?",
        const=0,
        metavar="PIXELS",
        help="no keypoints on people and vehicles, nor within PIXELS of them (0)",
    ),
    "--keep": dict(
        metavar="boundaries|static|inverse|static-boundaries",
        default="boundaries",
        help="keypoints on boundaries, on all but movable things, on all but boundaries, or on boundaries "
        "between static classes (boundaries)",
    ),
    "--ids": dict(
        metavar="labels|train",
        default="labels",
        help="label maps hold label ids or train ids (labels)",
    ),
    "--margin": dict(
        type=int, default=0, metavar="PIXELS", help="no keypoints near the frame's border (0)"
    ),
}


def build_parser():
    parser = _Parser(
        prog="thesis-repro",
        description="Keypoint masks from semantic segmentation for monocular visual "
        "odometry. thesis-repro COMMAND --help shows options, with defaults in parentheses, and examples.",
    )
    parser.add_argument(
        "--version", action="version", version=f"thesis-repro {version('thesis-repro')}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    examples = (
        (Path(__file__).parent / "report/templates/examples.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )

    def command(function, *shared, **changes):
        """Add the parser of a command with options of SHARED and MASK_OPTIONS. changes: arguments
        that differ, by option.
        """
        name = function.__name__.replace("_", "-")
        sub = commands.add_parser(
            name,
            help=function.__doc__,
            # python -OO leaves docstrings out
            description=textwrap.fill(function.__doc__ or "", 80),
            epilog="\n".join(
                [
                    "examples:",
                    *(line for line in examples if line.startswith(f"thesis-repro {name} ")),
                ]
            ),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(function=function)
        mask_options = sub.add_argument_group("how masks are made from label maps")
        for name in shared:
            group = mask_options if name in MASK_OPTIONS else sub
            group.add_argument(
                name, **(SHARED | MASK_OPTIONS)[name] | changes.get(name.strip("-"), {})
            )
        return sub

    add = command(synthesize).add_argument
    add(
        "out", type=Path, metavar="OUT", help="new folder, or one in which this command was stopped"
    )
    add("--profile", choices=tuple(PROFILES), default="demo", help="size of the world (demo)")

    add = command(check_data, "--kitti", "--cityscapes").add_argument
    add(
        "--kitti-semantic",
        type=Path,
        metavar="ROOT",
        help="folder of KITTI's street scenes: train/, trainannot/",
    )
    add(
        "--deep",
        action="store_true",
        help="decode every file, on all cores, not only check its header and end",
    )

    add = command(predict, "--frames", "--dask", "--output").add_argument
    add(
        "--images",
        type=Path,
        nargs="+",
        action="extend",
        required=True,
        metavar="DIR",
        help="folder of PNG or JPEG images, one sequence, or a folder of sequences; several get a subfolder each",
    )
    add(
        "--model",
        type=Path,
        nargs="+",
        action="extend",
        default=[],
        metavar="FILE",
        help="trained model (.keras, .hdf5); the outputs of several are averaged (the model in the package)",
    )

    add = command(masks, *SEQUENCE, *MASK_OPTIONS, "--output").add_argument
    add(
        "--labels",
        type=Path,
        required=True,
        metavar="DIR",
        help="a label map for each frame, or a folder of them for each sequence",
    )
    add(
        "--dilation",
        **WIDTHS,
        help="in pixels, such as 5,10 or 1-15; several get a subfolder each",
    )

    sub = command(odometry, *SEQUENCE, *MASK_OPTIONS, "--invert", "--plot", "--json")
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    add(
        "--speed",
        type=float,
        metavar="M_PER_S",
        help="speed, if there is no ground truth (1 m a frame)",
    )
    either(
        "--masks",
        type=Path,
        metavar="DIR",
        help="a mask for each frame or one for all: 255 keep, 0 ignore; or a folder for each sequence",
    )
    either(
        "--labels",
        type=Path,
        metavar="DIR",
        help="a label map for each frame, or a folder of them for each sequence; needs --dilation",
    )
    add(
        "--dilation",
        type=int,
        metavar="W",
        help="dilation width, in pixels, of masks from label maps",
    )
    add(
        "--estimator",
        metavar="thesis|inliers|refined",
        help="motion by a vote of all matched points (PySLAM) or of RANSAC's inliers, or by least squares (thesis)",
    )
    add(
        "--detector",
        metavar="shi-tomasi|orb",
        help="keypoint detector; the tracker stays the same (shi-tomasi)",
    )
    add(
        "--fallback",
        action="store_true",
        default=None,
        help="use all keypoints where masked ones fail",
    )
    add(
        "--max-keypoints",
        type=int,
        metavar="N",
        help="maximum number of keypoints in a frame (2000)",
    )
    add(
        "--output", type=Path, metavar="POSES.txt", help="write the estimated poses in KITTI format"
    )
    add("--tum", type=Path, metavar="FILE", help="write the estimated poses in TUM format")
    add(
        "--video",
        type=Path,
        metavar="OUT.webm",
        help="write a video of the frames, the keypoints and the path",
    )

    sub = command(
        study,
        "--kitti",
        "--sequences",
        "--frames",
        "--invert",
        *MASK_OPTIONS,
        "--output",
        kitti=REQUIRED,
    )
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    for kind, content in (
        ("labels", "label maps, any size"),
        ("masks", "masks, 255 keeps keypoints, 0 ignores them"),
    ):
        add(
            f"--{kind}",
            dest="sources",
            action="append",
            metavar="DIR",
            type=lambda text, kind=kind: (kind, _path(text)),
            help=f"folder with a subfolder NN for each sequence ({content}); can be repeated",
        )
    add(
        "--name",
        action="append",
        default=[],
        metavar="NAME",
        help="name of a --labels or --masks folder (its name)",
    )
    add(
        "--widths",
        **WIDTHS,
        help="dilation widths of masks from label maps, in pixels, such as 5,10 (1-15)",
    )
    add(
        "--controls",
        type=int,
        nargs="?",
        const=10,
        metavar="W",
        help="run controls, too, for masks of width W (10)",
    )
    add(
        "--repetitions",
        type=int,
        default=5,
        metavar="N",
        help="shuffles of the matched points for each run (5)",
    )
    add(
        "--estimator",
        nargs="+",
        choices=("thesis", "refined"),
        default=["thesis"],
        help="one or both (thesis)",
    )
    either(
        "--jobs",
        type=_setting(partial(number, "JOBS")),
        metavar="N",
        help="number of processes (number of cores)",
    )
    either("--dask", **SHARED["--dask"])
    add(
        "--plan",
        action="store_true",
        help="print the estimated time and disk space, and run nothing",
    )

    add = command(
        evaluate,
        "--kitti",
        "--sequence",
        "--frames",
        "--plot",
        "--json",
        sequence={
            "required": False,
            "help": "sequence of the files; of folders, evaluate only this sequence",
        },
    ).add_argument
    add(
        "poses",
        type=Path,
        nargs="+",
        metavar="FILE_OR_DIR",
        help="trajectory in KITTI format (a line for each frame) or TUM format (matched by time, keyframes suffice), "
        "or folder with NN.txt or NN.tum for each sequence, which also gets a mean",
    )
    add(
        "--align",
        choices=("none", "se3", "sim3", "scale"),
        default="none",
        help="alignment to the ground truth for ATE, RPE (per frame), t_rel (%%) and r_rel (deg/100 m) (none)",
    )

    # named as evo's options
    add(
        "--t_offset",
        type=float,
        default=0.0,
        metavar="SECONDS",
        help="add this to the times of files in TUM format, such as ROS's (0)",
    )
    add(
        "--t_max_diff",
        type=float,
        metavar="SECONDS",
        help="largest difference between the times of a pose and its frame (0.01)",
    )

    command(plan, "--kitti", kitti=REQUIRED)
    return parser


def main(arguments=None):
    for stream in ("stdout", "stderr"):
        if getattr(sys, stream) is None:  # it was closed
            setattr(sys, stream, open(os.devnull, "w", encoding="utf-8"))
    options = build_parser().parse_args(arguments)
    options.command_line = shlex.join(
        ["thesis-repro", *(sys.argv[1:] if arguments is None else arguments)]
    )
    try:
        try:
            os.getcwd()
        except FileNotFoundError:
            raise InputError("the working folder was deleted; change to another one") from None
        with console.stoppable():
            console.need_addresses(4 if options.function is predict else 2)
            code = options.function(options) or 0
            sys.stdout.flush()
            return code
    except BrokenPipeError:  # the reader of the output has ended, such as head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except Exception as error:
        return console.report_error(error)
    except KeyboardInterrupt as stop:
        with suppress(OSError):  # the terminal may be gone
            print("stopped; run the same command again to resume", file=sys.stderr)
        return 128 + (stop.args[0] if stop.args else signal.SIGINT)
