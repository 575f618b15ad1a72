"""The command line: thesis-repro COMMAND, or python -m thesis_repro COMMAND."""

import argparse
import json
import os
import shlex
import sys
from dataclasses import fields, replace
from importlib.metadata import version
from pathlib import Path

from thesis_repro import InputError, longrun, one_line

DESCRIPTION = "Keypoint masks from semantic segmentation for monocular visual odometry: a thesis, reproduced."


# The commands. Each imports what it needs itself, so that --help and errors of the command line come at once.


def synthesize(options):
    """write the embedded world: a rendered street world in KITTI's and Cityscapes' layouts"""
    from thesis_repro import world
    from thesis_repro.settings import PROFILES, SEED

    with longrun.logged(options.out, options.command_line) as run:
        new, total = world.write(options.out, **PROFILES[options.profile].world, seed=SEED)
        run.end(f"{options.out}: kitti and cityscapes of the embedded world, profile {options.profile}, "
                f"{total:,} pictures with their label maps{_from_before(total - new)}")


def check_data(options):
    """say what is there, missing or wrong in folders of KITTI, Cityscapes, KITTI's street scenes, and what can run"""
    from thesis_repro import check

    folders = {options.kitti: check.check_kitti, options.cityscapes: check.check_cityscapes,
               options.kitti_semantic: check.check_kitti_semantic}
    if not any(folders):
        raise InputError("nothing to check: name a folder with --kitti, --cityscapes or --kitti-semantic "
                         "(make check-data KITTI=... CITYSCAPES=... KITTI_SEMANTIC=...)")
    problems = []
    for root, check_folder in folders.items():
        if root:
            facts, its_problems = check_folder(root, options.deep)
            print("\n".join([str(root), *(f"  {fact}" for fact in facts)]))
            problems += its_problems
    for problem in problems:
        print(f"wrong: {one_line(problem)}", file=sys.stderr)
    return 1 if problems else 0


def predict(options):
    """write label maps (8-bit ids, 320x320 PNG, named like the frames) for folders of images or sequences"""
    from thesis_repro.segmentation import archive, quietly
    from thesis_repro.settings import scheduler_address
    from thesis_repro.study import cluster

    names = [folder.resolve().name for folder in options.images]
    if len(set(names)) < len(names):
        raise InputError("--images: two folders have one name, so their label maps would share a folder; give them to "
                         "two commands")
    outputs = [options.output] if len(names) == 1 else [options.output / name for name in names]
    sequences = [(_images_in(folder), output) for folder, output in zip(options.images, outputs)]
    for output in outputs:
        _check_result_folder(output, *options.images, *(paths[0].parent for paths, _ in sequences), *options.model)
    for path in options.model:
        archive.check(path)
    scheduler_address(options.dask)
    with quietly():  # takes seconds, so files are checked before
        from thesis_repro.segmentation import prediction
    model_files = options.model or [prediction.SHIPPED]
    with longrun.logged(options.output, options.command_line) as run:
        if options.dask:
            with cluster.open_pool(1, options.dask) as pool:
                new = prediction.spread_label_maps(pool.run, model_files, sequences)
        else:
            model = prediction.load(tuple(model_files))
            new = sum(prediction.write_label_maps(model, paths, output) for paths, output in sequences)
        total = sum(len(paths) for paths, _ in sequences)
        run.end("\n".join(f"{output}: {len(paths)} label maps" for paths, output in sequences)
                + _from_before(total - new))


def masks(options):
    """write the keypoint masks of a sequence (A.8): one 8-bit PNG a frame, 255 keep, 0 ignore, for odometry --masks"""
    from thesis_repro.masks import LabelMasks, write_masks

    sequence, widths = _sequence(options), sorted(set(options.dilation))
    masks_by_width = [LabelMasks(options.labels, sequence, width, _mask_settings(options)) for width in widths]
    _check_result_folder(options.output, options.labels, sequence.folder)
    for width, its_masks in zip(widths, masks_by_width):
        folder = options.output if len(widths) == 1 else options.output / f"mask{width}"
        write_masks(its_masks, folder)
        print(f"{folder}: {len(its_masks)} masks of width {width}")


def odometry(options):
    """run the visual odometry over one sequence and print its errors, keypoints and time"""
    from thesis_repro import odometry
    from thesis_repro.kitti import write_kitti_poses, write_tum
    from thesis_repro.odometry import metrics
    from thesis_repro.odometry.refined import boresight
    from thesis_repro.report import terminal

    if bool(options.labels) != (options.dilation is not None):
        raise InputError("--labels: needs --dilation W, the width in pixels by which the boundaries are dilated"
                         if options.labels else
                         "--dilation: needs --labels DIR, the label maps whose boundaries are dilated")
    if not options.labels:
        _refuse_mask_settings(_mask_settings(options))
    chosen = {field.name: vars(options)[field.name] for field in fields(odometry.OdometrySettings)
              if vars(options).get(field.name) is not None}
    settings = replace(odometry.PRESETS[options.pyslam], **chosen)
    if options.video:
        from thesis_repro.report import video

        video.check_name(options.video)
    if options.plot:
        from thesis_repro.report import trajectories

        trajectories.check_name(options.plot)
    sequence = _sequence(options)
    _check_new_files({"--output": options.output, "--tum": options.tum, "--plot": options.plot,
                      "--video": options.video},
                     [sequence.poses_path, sequence.folder / "calib.txt", sequence.folder / "times.txt"],
                     [sequence.frame_paths[0].parent, options.masks, options.labels])
    masks = _masks(options, sequence)
    result = odometry.run(sequence, settings, masks, description=f"sequence {sequence.name}")
    if options.boresight:
        result = result.with_poses(boresight.corrected(result.poses, options.boresight))
    record = terminal.run(result, sequence, settings.alignment)
    if options.output:
        write_kitti_poses(options.output, result.poses)
    if options.tum:
        write_tum(options.tum, result.poses, sequence.times)
    if options.video:
        video.write_video(options.video, sequence, settings, masks)
    if options.plot:
        true = sequence.poses if sequence.has_truth else None
        paths = {"estimate": result.poses if true is None else metrics.shifted(result.poses, true, settings.alignment)}
        trajectories.write(options.plot, trajectories.figure(paths, true, f"sequence {sequence.name}"))
    print(json.dumps(record) if options.json else terminal.run_text(record, sequence, options.speed))


def boresight(options):
    """estimate the constant rotation between camera and ground truth (degrees; for odometry --boresight)"""
    from thesis_repro import odometry
    from thesis_repro.kitti import Sequence
    from thesis_repro.odometry.refined import boresight
    from thesis_repro.report import terminal

    paths = {}
    for name in dict.fromkeys(options.sequences):
        sequence = Sequence(options.kitti, name)
        result = odometry.run(sequence, replace(odometry.THESIS, estimator="refined"), description=f"sequence {name}")
        paths[name] = result.poses, sequence.poses
    rotation, table = boresight.estimate(list(paths.values())), boresight.explained(paths)
    print(json.dumps(terminal.angles(rotation, table)) if options.json else terminal.angles_text(rotation, table))


def study(options):
    """run the odometry with masks of your own beside all keypoints and controls, and leave tables, figures, a page"""
    from thesis_repro import kitti
    from thesis_repro.settings import ALL_WIDTHS, MOST_JOBS, cores, scheduler_address
    from thesis_repro.study import jobs, series, sources

    if not options.sources:
        raise InputError("no masks: name a folder of label maps with --labels or of masks with --masks")
    widths, settings = options.widths, _mask_settings(options)
    if any(kind == "labels" for kind, _ in options.sources):
        widths = ALL_WIDTHS if widths is None else widths
    else:
        if widths or options.controls not in (None, True):
            raise InputError(f"{'--widths' if widths else f'--controls {options.controls}'}: only masks from label "
                             "maps (--labels) have a width")
        _refuse_mask_settings(settings)
        widths = ()
    scheduler_address(options.dask)
    planned = series.Study(
        options.kitti.absolute(), tuple(options.sequences or kitti.sequences(options.kitti)),
        sources.named(options.sources, options.name, settings), tuple(sorted(set(widths))),
        jobs.CONTROL_WIDTH if options.controls is True else options.controls, tuple(dict.fromkeys(options.estimator)),
        options.repetitions, options.frames)
    planned.check()
    if options.plan:
        from thesis_repro.report import terminal
        from thesis_repro.study import plan

        print(terminal.plan_text(plan.of_study(planned)))
        return 0
    if options.jobs is not None and not 1 <= options.jobs <= MOST_JOBS:
        raise InputError(f"--jobs {options.jobs}: must be 1 or more, and at most {MOST_JOBS}")
    folder = options.output.absolute()
    _check_result_folder(folder, options.kitti, *(source.folder for source in planned.sources))
    from thesis_repro.report import study  # loads all that draws, so the input is checked before

    with longrun.logged(folder, options.command_line) as run, longrun.claimed(folder):
        summary = planned.run(folder, options.jobs or cores(), options.dask)
        counts, page = summary.attrs, study.write(planned, summary, folder)
        failed = f", {counts['failed']:,} failed (see above)" * (counts["failed"] > 0)
        run.end(f"{len(summary):,} runs{_from_before(counts['kept'])}{failed}; open {page} in a browser")
    return 1 if failed else 0


def evaluate(options):
    """compare trajectories with the true poses: the thesis's RMSE and MAE, ATE, RPE, KITTI's t_rel and r_rel"""
    from thesis_repro.kitti import true_poses
    from thesis_repro.report import trajectories

    if options.plot:
        trajectories.check_name(options.plot)
    true = true_poses(options.kitti, options.sequence)
    _check_new_files({"--plot": options.plot}, options.poses, [])
    paths = trajectories.read(options.poses, true)
    rows = trajectories.evaluate(paths, true, options.align)
    if options.plot:
        aligned = trajectories.aligned(paths, true, options.align)
        trajectories.write(options.plot, trajectories.figure(aligned, true, f"sequence {options.sequence}"))
    print(json.dumps(rows) if options.json else trajectories.text(rows, options.align))


def plan(options):
    """say how long make figures would take here, training included, from a minute of timing"""
    from thesis_repro import cityscapes
    from thesis_repro.report import terminal
    from thesis_repro.settings import read_settings
    from thesis_repro.study import plan

    # the sizes of the thesis, but for what make's PROFILE, EPOCHS and so on say
    sizes = read_settings({"THESIS_REPRO_PROFILE": "thesis"} | {
        name: value for name, value in os.environ.items() if name.startswith("THESIS_REPRO_")}).sizes
    images = len(cityscapes.pairs(options.cityscapes, "train")) if options.cityscapes else 0
    print(terminal.plan_text(plan.of_thesis(options.kitti, sizes, options.complete, images)))


# What several commands share


def _from_before(count):
    return f", {count:,} of them from before" * (count > 0)


def _sequence(options):
    from thesis_repro.kitti import Sequence

    return Sequence(options.kitti, options.sequence, options.camera, getattr(options, "speed", None))


def _images_in(folder):
    """The images of a folder, or of a KITTI sequence folder, which must be complete."""
    from thesis_repro import files, kitti

    where = kitti.images_of(folder)
    if not where.is_dir():
        raise InputError(f"{folder}: no such folder; --images must name a folder of PNG or JPEG images "
                         "or a KITTI sequence folder that holds image_0 or image_2")
    paths = files.images(where)
    if not paths:
        raise InputError(f"{where}: holds no PNG or JPEG images")
    if where != folder:
        kitti.check_numbering(paths)
    return paths


def _mask_settings(options):
    from thesis_repro.masks import MaskSettings

    return MaskSettings(options.boundaries, options.symmetric, tuple(options.classes), options.without_movable,
                        options.margin)


def _refuse_mask_settings(settings):
    if settings != type(settings)():
        raise InputError("--boundaries, --symmetric, --classes, --without-movable, --margin: need --labels DIR, "
                         "the label maps that masks are made from")


def _masks(options, sequence):
    """The masks that --masks or --labels name; None without."""
    from thesis_repro.masks import LabelMasks, MaskFolder

    if options.masks:
        return MaskFolder(options.masks, sequence)
    return LabelMasks(options.labels, sequence, options.dilation, _mask_settings(options)) if options.labels else None


def _check_result_folder(output, *inputs):
    """Raise InputError where the folder for results holds something that is read, which could be replaced."""
    for path in inputs:
        if path.resolve().is_relative_to(output.resolve()):
            raise InputError(f"--output {output}: {'is' if path.resolve() == output.resolve() else 'holds'} the input "
                             f"{path}; name another folder")


def _check_new_files(outputs, input_files, input_folders):
    """Raise InputError, before anything runs, for a file that cannot be written, or that would harm an input.

    outputs: {option: path or None}.
    """
    from thesis_repro.files import check_output

    option_of = {}
    for option, path in outputs.items():
        if path is None:
            continue
        check_output(path)
        place = path.resolve()
        if place in {file.resolve() for file in input_files}:
            raise InputError(f"{option} {path}: is an input, which would be lost; name another file")
        if place.parent in {folder.resolve() for folder in input_folders if folder}:
            raise InputError(f"{option} {path}: would stand among the inputs in {path.parent}; name another folder")
        if place in option_of:
            raise InputError(f"{option} {path}: is the file of {option_of[place]} too; give each its own")
        option_of[place] = option


# The parser


class _Once(argparse.Action):
    """Stores what an option is given, and refuses it a second time: the first would count for nothing."""

    def __call__(self, parser, namespace, values, option_string=None):
        given = vars(namespace).setdefault("given", set())
        if option_string and self.dest in given:
            several = ", with all its values behind it" if self.nargs == "+" else ""
            raise argparse.ArgumentError(self, f"is given twice; give it once{several}")
        given.add(self.dest)
        setattr(namespace, self.dest, values)


class _Parser(argparse.ArgumentParser):
    """argparse with errors of one line, options that count only in full, and no empty paths."""

    def __init__(self, **options):
        super().__init__(allow_abbrev=False, **options)
        self.register("action", None, _Once)
        self.register("type", Path, _path)

    def error(self, message):
        self.exit(2, f"error: {one_line(message)}; see {self.prog} --help\n")


def _path(text):
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


def build_parser():
    parser = _Parser(prog="thesis-repro", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"thesis-repro {version('thesis-repro')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)

    def command(function):
        sub = commands.add_parser(function.__name__.replace("_", "-"), help=function.__doc__,
                                  description=function.__doc__)
        sub.set_defaults(function=function)
        return sub

    def add_kitti(add, **required):
        add("--kitti", type=Path, metavar="ROOT", help="folder that holds sequences and poses", **required)

    def add_sequence(add):
        add_kitti(add)
        add("--sequence", required=True, metavar="NN",
            help="sequence, 00 to 21 (6 for 06); without --kitti a folder of one's own: calib.txt with a line P0, the "
                 "frames, and perhaps times.txt and poses.txt")

    def add_camera(add):
        add("--camera", metavar="image_N", help="folder of the frames (image_0, or else image_2, read as gray)")

    def add_mask_settings(add):
        add("--boundaries", choices=("canny", "exact"), default="canny",
            help="Canny on enlarged label ids as in the thesis (canny), or every change of class (exact)")
        add("--symmetric", action="store_true", help="masks in the middle of the boundaries, not half a pixel aside")
        add("--classes", nargs="+", default=(), metavar="NAME", help="boundaries of these Cityscapes classes alone")
        add("--without-movable", type=int, nargs="?", const=0, metavar="PIXELS",
            help="nothing on people and vehicles, nor so many pixels around them (0)")
        add("--margin", type=int, default=0, metavar="PIXELS", help="nothing along the frame's rim (0)")

    def add_json(add, what="one JSON object"):
        add("--json", action="store_true", help=f"print {what}")

    add = command(synthesize).add_argument
    add("out", type=Path, metavar="OUT", help="folder to write, new or left unfinished before")
    add("--profile", choices=("smoke", "demo", "thesis"), default="demo", help="size of the world (demo)")

    add = command(check_data).add_argument
    add_kitti(add)
    add("--cityscapes", type=Path, metavar="ROOT",
        help="folder that holds leftImg8bit and gtFine, or train, trainannot, val and valannot")
    add("--kitti-semantic", type=Path, metavar="ROOT", help="folder that holds train and trainannot")
    add("--deep", action="store_true", help="decode every file, on all cores; otherwise names, both ends of each file, "
                                            "and the first and last frame")

    add = command(predict).add_argument
    add("--images", type=Path, nargs="+", required=True, metavar="DIR_OR_SEQUENCE",
        help="folder of PNG or JPEG images, or a KITTI sequence folder; several get a folder each")
    add("--output", type=Path, required=True, metavar="DIR", help="folder for the label maps")
    add("--dask", metavar="ADDRESS",
        help="scheduler (tcp://host:8786) whose workers make the label maps, with the same bits")
    add("--model", type=Path, nargs="+", default=[], metavar="FILE",
        help="a trained model (.keras, .hdf5), several for the mean of their probabilities; without it the model in "
             "the package")

    add = command(masks).add_argument
    add("--labels", type=Path, required=True, metavar="DIR", help="one label map a frame")
    add_sequence(add)
    add_camera(add)
    add("--dilation", type=int, nargs="+", required=True, metavar="W", help="width, pixels; several get a folder each")
    add("--output", type=Path, required=True, metavar="DIR", help="folder for the masks")
    add_mask_settings(add)

    sub = command(odometry)
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    add_sequence(add)
    add_camera(add)
    add("--speed", type=float, metavar="M_PER_S",
        help="metres a second where there are no true poses to take the length of steps from (without it, 1 m a frame)")
    either("--masks", type=Path, metavar="DIR", help="one mask a frame, 255 keep, 0 ignore")
    either("--labels", type=Path, metavar="DIR", help="one label map a frame, with --dilation")
    add("--dilation", type=int, metavar="W", help="dilation width in pixels of masks from label maps")
    add_mask_settings(add)
    add("--pyslam", choices=("2021", "2024"), default="2021",
        help="the preset: PySLAM of the thesis (default), or its later algorithm; what follows changes it")
    add("--estimator", metavar="thesis|inliers|refined",
        help="all points vote on the motion (PySLAM); RANSAC's inliers vote; or it is fitted by least squares")
    add("--detector", metavar="shi-tomasi|orb", help="of keypoints; they are tracked all the same")
    add("--max-keypoints", type=int, metavar="N", help="most keypoints of a detection (2000)")
    add("--boresight", type=float, nargs=3, metavar=("PITCH", "YAW", "ROLL"),
        help="turn the path by the rotation between camera and truth, degrees; see the command boresight")
    add("--output", type=Path, metavar="POSES.txt", help="estimated poses in KITTI's form")
    add("--tum", type=Path, metavar="FILE", help="estimated poses in TUM's form")
    add("--plot", type=Path, metavar="FILE",
        help="the path from above with the true one, and the error along the way (.png, .svg, .pdf, ...)")
    add("--video", type=Path, metavar="OUT.mp4", help="what the odometry sees and where it goes")
    add_json(add)

    add = command(boresight).add_argument
    add_kitti(add, required=True)
    add("--sequences", nargs="+", required=True, metavar="NN", help="sequences, 00 to 10")
    add_json(add)

    sub = command(study)
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    add_kitti(add, required=True)
    add("--sequences", nargs="+", metavar="NN", help="those to run (all that ROOT holds)")
    for kind, what in (("labels", "a folder of label maps (Cityscapes ids, any size, named like the frames) for each "
                                  "sequence, DIR/NN; several times for several networks"),
                       ("masks", "the same with masks of the frames' size, 255 keep, 0 ignore")):
        add(f"--{kind}", dest="sources", action="append", metavar="DIR", help=what,
            type=lambda text, kind=kind: (kind, _path(text)))
    add("--name", action="append", default=[], metavar="NAME", help="of each --labels and --masks (the folder's)")
    add("--widths", type=int, nargs="+", metavar="W", help="dilation widths of masks from label maps, pixels (1 to 15)")
    add_mask_settings(add)
    add("--controls", type=int, nargs="?", const=True, metavar="W",
        help="masks and limits without segmentation, beside masks of width W (10)")
    add("--repetitions", type=int, default=5, metavar="N",
        help="of every run, each with the matched points shuffled in another way (5)")
    add("--estimator", nargs="+", choices=("thesis", "refined"), default=["thesis"], help="one (thesis) or both")
    add("--frames", type=int, metavar="N", help="from the start of each sequence (all)")
    either("--jobs", type=int, metavar="N", help="processes at once (as many as there are cores)")
    either("--dask", metavar="ADDRESS", help="a Dask scheduler that the runs are sent to, tcp://host:8786")
    add("--plan", action="store_true", help="say what it would take, and run nothing")
    add("--output", type=Path, required=True, metavar="DIR", help="folder for everything it writes")

    add = command(evaluate).add_argument
    add_sequence(add)
    add("poses", type=Path, nargs="+", metavar="POSES.txt", help="trajectories in KITTI's form")
    add("--align", choices=("none", "se3", "sim3", "scale"), default="none",
        help="lay them over the truth for ATE, RPE, t_rel and r_rel (none)")
    add("--plot", type=Path, metavar="FILE",
        help="all paths from above, and their errors along the way (.png, .svg, .pdf, ...)")
    add_json(add, "a JSON list, one object a trajectory")

    add = command(plan).add_argument
    add_kitti(add, required=True)
    add("--cityscapes", type=Path, metavar="ROOT", help="count the training of a network on these images")
    add("--complete", action="store_true", help="plan for the complete benchmark, even where ROOT holds less")
    return parser


def main(arguments=None):
    parser = build_parser()
    if "_ARGCOMPLETE" in os.environ:  # the shell asks what could come next
        import argcomplete

        argcomplete.autocomplete(parser)
    options = parser.parse_args(arguments)
    options.command_line = shlex.join(["thesis-repro", *(sys.argv[1:] if arguments is None else arguments)])
    try:
        longrun.need_addresses(4 if options.function is predict else 2)
        return options.function(options) or 0
    except Exception as error:
        return longrun.report_error(error)
    except KeyboardInterrupt:
        print("stopped; the same command goes on where it can", file=sys.stderr)
        return 130
