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
from importlib.metadata import version
from pathlib import Path

from thesis_repro import InputError, longrun, one_line
from thesis_repro.settings import PROFILES, SEED, frames, processes, widths

# the files that options name
WRITTEN = {"output": "poses in KITTI's form", "tum": "poses in TUM's form", "plot": "the paths", "video": "the video"}
ENDINGS = {"plot": (".png", ".svg", ".pdf", ".jpg"), "video": (".mp4",)}


# The commands. Each imports what it needs itself, so that --help and errors of the command line come at once.


def synthesize(options):
    """write the embedded world: a rendered street world in KITTI's and Cityscapes' layouts"""
    from thesis_repro import world

    with longrun.logged(options.out, options.command_line) as run:
        new, total = world.write(options.out, **PROFILES[options.profile].world, seed=SEED)
        run.end(f"{options.out}: kitti and cityscapes of the embedded world, profile {options.profile}, "
                f"{total:,} pictures with their label maps{_from_before(total - new)}")


def check_data(options):
    """say what is there, missing or wrong in folders of KITTI, Cityscapes, KITTI's street scenes, and what can run"""
    from thesis_repro import check

    roots = options.kitti, options.cityscapes, options.kitti_semantic
    if not any(roots):
        raise InputError("nothing to check: give --kitti (make: KITTI=), --cityscapes or --kitti-semantic")
    return 0 if check.report(*roots, options.deep) else 1


def predict(options):
    """write label maps (8-bit ids, 320x320 PNG, named like the frames) for folders of images or sequences"""
    from thesis_repro.segmentation import quietly
    from thesis_repro.settings import scheduler_address
    from thesis_repro.study import cluster

    images = [(folder, paths) for given in options.images for folder, paths in _image_folders(given)]
    names = [folder.resolve().name for folder, _ in images]
    if len(set(names)) < len(names):
        raise InputError("--images: two folders have one name; give them to two commands")
    # a KITTI folder has a folder for each sequence, even where there is only one
    several = [folder for folder, _ in images] != options.images[:1]
    sequences = [(paths[:options.frames], options.folder / name if several else options.folder)
                 for name, (_, paths) in zip(names, images)]
    _check_outputs(options, *options.images, *(paths[0].parent for paths, _ in sequences), *options.model)
    scheduler_address(options.dask)
    with quietly():  # takes seconds, so files are checked before
        from thesis_repro.segmentation import prediction
    model_files = options.model or [prediction.SHIPPED]
    with longrun.logged(options.folder, options.command_line) as run:
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

    sequence = _sequence(options)
    chosen = [LabelMasks(options.labels, sequence, width, _mask_settings(options))
              for width in sorted(set().union(*options.dilation))]
    _check_outputs(options, options.labels, sequence.folder)
    _look_at(sequence, chosen)
    for its_masks in chosen:
        width = its_masks.dilation_width
        folder = options.folder if len(chosen) == 1 else options.folder / f"mask{width}"
        write_masks(its_masks, folder)
        print(f"{folder}: {len(its_masks)} masks of width {width}")


def odometry(options):
    """run the visual odometry over one sequence and print its errors, keypoints and time"""
    from thesis_repro import check, odometry
    from thesis_repro.kitti import write_kitti_poses, write_tum
    from thesis_repro.odometry import metrics
    from thesis_repro.odometry.refined import boresight
    from thesis_repro.report import terminal

    chosen = {field.name: vars(options)[field.name] for field in fields(odometry.OdometrySettings)
              if vars(options).get(field.name) is not None}
    settings = replace(odometry.PRESETS[options.pyslam], **chosen)
    sequence = _sequence(options)
    masks = _masks(options, sequence)
    _check_outputs(options, sequence.poses_path, sequence.folder / "calib.txt", sequence.folder / "times.txt",
                   sequence.frame_paths[0].parent, options.masks, options.labels)
    _look_at(sequence, [masks] if masks else [])
    result = odometry.run(sequence, settings, masks, description=f"sequence {sequence.name}")
    if options.boresight:
        result = result.with_poses(boresight.corrected(result.poses, options.boresight))
    if options.output:
        write_kitti_poses(options.output, result.poses)
    if options.tum:
        write_tum(options.tum, result.poses, sequence.times)
    for line in check.path_oddities(sequence.name, result.poses, sequence.poses) if sequence.has_truth else ():
        longrun.remark(line, warning=True)
    record = terminal.run(result, sequence, settings.alignment)
    if options.video:
        from thesis_repro.report import video

        video.write_video(options.video, sequence, settings, masks)
    if options.plot:
        from thesis_repro.report import trajectories

        true = sequence.poses if sequence.has_truth else None
        paths = {"estimate": result.poses if true is None else metrics.shifted(result.poses, true, settings.alignment)}
        trajectories.write(options.plot, trajectories.figure(paths, true, f"sequence {sequence.name}"))
    _print(options, record, "run.txt.j2", sequence=sequence, speed=options.speed, length=metrics.RELATIVE_LENGTH)


def boresight(options):
    """estimate the constant rotation between camera and ground truth (degrees; for odometry --boresight)"""
    from thesis_repro import kitti, odometry
    from thesis_repro.odometry.refined import boresight
    from thesis_repro.report import terminal

    paths = {}
    names = options.sequences or kitti.sequences(options.kitti)
    for name in dict.fromkeys(kitti.name_of(options.kitti, name) for name in names):
        sequence = kitti.Sequence(options.kitti, name).subset(options.frames)
        _look_at(sequence, [])
        result = odometry.run(sequence, replace(odometry.THESIS, estimator="refined"), description=f"sequence {name}")
        paths[name] = result.poses, sequence.poses
    rotation, table = boresight.estimate(list(paths.values())), boresight.explained(paths)
    _print(options, terminal.angles(rotation, table), "angles.txt.j2", table=table)


def study(options):
    """run the odometry with masks of your own beside all keypoints and controls, and leave tables, figures, a page"""
    from thesis_repro import kitti
    from thesis_repro.settings import ALL_WIDTHS, cores, scheduler_address
    from thesis_repro.study import series, sources

    if not options.sources:
        raise InputError("no masks: name a folder of label maps with --labels or of masks with --masks")
    has_labels = any(kind == "labels" for kind, _ in options.sources)
    if options.widths and not has_labels:
        raise InputError("--widths: only masks from label maps (--labels) have a width")
    scheduler_address(options.dask)
    planned = series.Study(
        options.kitti.absolute(), tuple(dict.fromkeys(kitti.name_of(options.kitti, name) for name in options.sequences))
        or tuple(kitti.sequences(options.kitti)),
        sources.named(options.sources, options.name, _mask_settings(options, has_labels), options.invert),
        tuple(sorted(set().union(*options.widths or [ALL_WIDTHS] if has_labels else []))),
        options.controls, tuple(dict.fromkeys(options.estimator)), options.repetitions, options.frames)
    planned.check()
    if options.plan:
        from thesis_repro.study import plan

        _print(options, plan.of_study(planned), "plan.txt.j2")
        return 0
    folder = options.folder.absolute()
    _check_outputs(options, options.kitti, *(source.folder for source in planned.sources))
    from thesis_repro.report import study  # loads all that draws, so the input is checked before

    with longrun.logged(folder, options.command_line) as run, longrun.claimed(folder):
        warnings = [line for sequence, of_sequence in planned.masks() for line in _look_at(sequence, of_sequence)]
        summary = planned.run(folder, options.jobs or cores(), options.dask)
        for line in planned.path_oddities(summary, folder):
            longrun.remark(line, warning=True)
            warnings.append(line)
        counts, page = summary.attrs, study.write(planned, summary, folder, warnings)
        failed = f", {counts['failed']:,} failed (see above)" * (counts["failed"] > 0)
        run.end(f"{len(summary):,} runs{_from_before(counts['kept'])}{failed}; open {page} in a browser")
    return 1 if failed else 0


def evaluate(options):
    """compare trajectories with the true poses: the thesis's RMSE and MAE, ATE, RPE, KITTI's t_rel and r_rel"""
    from thesis_repro import check
    from thesis_repro.kitti import true_path
    from thesis_repro.report import trajectories

    files = trajectories.by_sequence(options.poses, options.kitti, options.sequence)
    if options.plot and len(files) > 1:
        raise InputError("--plot: shows one sequence; name it with --sequence")
    _check_outputs(options, *options.poses, *(file for of_sequence in files.values() for file in of_sequence.values()))
    rows = []
    for sequence, of_sequence in files.items():
        true, times = (values[:options.frames] for values in true_path(options.kitti, sequence))
        paths = {name: trajectories.read(file, times, options.frames) for name, file in of_sequence.items()}
        for name, (matched, poses) in paths.items():
            for line in check.path_oddities(name, poses, true[matched]):
                longrun.remark(line, warning=True)
        rows += trajectories.evaluate(paths, true, options.align, sequence)
    if options.plot:
        drawing = trajectories.figure(trajectories.aligned(paths, true, options.align), true, f"sequence {sequence}",
                                      {name: matched for name, (matched, _) in paths.items()})
        trajectories.write(options.plot, drawing)
    rows += list(trajectories.means(rows))
    _print(options, rows, "evaluate.txt.j2", alignment=options.align, table=trajectories.table(rows, options.align))


def plan(options):
    """say how long make figures would take here, training included, from a minute of timing"""
    from thesis_repro import cityscapes
    from thesis_repro.settings import read_settings
    from thesis_repro.study import plan

    # the sizes of the thesis, but for what make's PROFILE, EPOCHS and so on say
    sizes = read_settings({"THESIS_REPRO_PROFILE": "thesis"} | os.environ).sizes
    images = len(cityscapes.pairs(options.cityscapes, "train")) if options.cityscapes else 0
    _print(options, plan.of_thesis(options.kitti, sizes, images), "plan.txt.j2")


# What several commands share


def _from_before(count):
    return f", {count:,} of them from before" * (count > 0)


def _sequence(options):
    from thesis_repro.kitti import Sequence

    sequence = Sequence(options.kitti, options.sequence, options.camera, getattr(options, "speed", None))
    return sequence.subset(options.frames)


def _look_at(sequence, of_sequence):
    """Print what masks of a sequence hold, and a warning for what is odd in them and in it; returns the warnings."""
    from thesis_repro import check

    warnings = check.oddities(sequence)
    for masks in of_sequence:
        with suppress(InputError):  # of a file that cannot be read: what needs it says so
            line, odd = check.of_masks(masks, sequence)
            longrun.remark(line)
            warnings += odd
    for line in warnings:
        longrun.remark(line, warning=True)
    return warnings


def _image_folders(given):
    """(folder, its images) of a folder of images or of a sequence, which must be complete, or of a KITTI folder's."""
    from thesis_repro import files, kitti

    inside = [given / "sequences" / name for name in kitti.with_frames(given)] if (given / "sequences").is_dir() else []
    for folder in inside or [given]:
        where = kitti.images_of(folder)
        paths = files.images(where)
        if not paths:
            raise InputError(f"{where}: holds no PNG or JPEG images")
        if where != folder:
            kitti.check_numbering(paths)
        yield folder, paths


def _mask_settings(options, has_labels=True):
    from thesis_repro.masks import MaskSettings

    settings = MaskSettings(options.boundaries, options.symmetric, tuple(options.classes), options.without_movable,
                            options.margin, options.keep, options.ids)
    if not has_labels and settings != MaskSettings():
        raise InputError(f"{', '.join(MASKS)}: need --labels DIR, the label maps that masks are made from")
    return settings


def _masks(options, sequence):
    """The masks that --masks or --labels name; None without."""
    from thesis_repro.masks import LabelMasks, MaskFolder

    settings = _mask_settings(options, options.labels)
    if bool(options.labels) != (options.dilation is not None):
        raise InputError("--labels DIR, --dilation W: one needs the other")
    if options.labels:
        return LabelMasks(options.labels, sequence, options.dilation, settings)
    if options.invert and not options.masks:
        raise InputError("--invert: is for masks; name them with --masks DIR")
    return MaskFolder(options.masks, sequence, options.invert) if options.masks else None


def _check_outputs(options, *inputs):
    """Raise InputError, before anything runs, for an output that cannot be written or that would harm an input."""
    from thesis_repro.files import check_output

    taken, folder = {path.resolve() for path in inputs if path}, vars(options).get("folder")
    if folder and any(path.is_relative_to(folder.resolve()) for path in taken):
        raise InputError(f"--output {folder}: holds what this command reads; name another folder")
    for name, path in _named_files(options):
        if path.suffix.lower() not in ENDINGS.get(name, path.suffix.lower()):
            raise InputError(f"--{name} {path}: its name must end in {' or '.join(ENDINGS[name])}")
        check_output(path)
        if not taken.isdisjoint((path.resolve(), path.resolve().parent)):
            raise InputError(f"--{name} {path}: is or lies in what this command reads or writes; name another file")
        taken.add(path.resolve())


def _named_files(options):
    return [(name, vars(options)[name]) for name in WRITTEN if vars(options).get(name)]


def _print(options, record, template, **values):
    """Print a result, as JSON or as a template has it, and name the files of it on standard error."""
    from thesis_repro.files import is_stdout, is_stream
    from thesis_repro.report import texts

    text = json.dumps(record) if vars(options).get("json") else texts.render(template, record=record, **values).rstrip()
    print(text, file=sys.stderr if any(is_stdout(path) for _, path in _named_files(options)) else None)
    for name, path in _named_files(options):
        if not is_stream(path):
            longrun.remark(f"{path}: {WRITTEN[name]}")


# The parser


class _Parser(argparse.ArgumentParser):
    """argparse with errors of one line, options that count only in full, and no empty paths."""

    def __init__(self, **options):
        super().__init__(allow_abbrev=False, **options)
        self.register("type", Path, _path)

    def error(self, message):
        self.exit(2, f"error: {one_line(message)}; see {self.prog} --help\n")


def _path(text):
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


# options of several commands
SHARED = {
    "--kitti": dict(type=Path, metavar="ROOT", help="folder that holds sequences and poses"),
    "--sequence": dict(required=True, metavar="NN", help="00 to 21; without --kitti a folder of one's own frames"),
    "--frames": dict(type=frames, metavar="N|all", help="how many from the start of a sequence, 5 or more (all)"),
    "--camera": dict(metavar="image_N", help="folder of the frames (image_0, or else image_2, read as gray)"),
    "--cityscapes": dict(type=Path, metavar="ROOT", help="folder that holds leftImg8bit and gtFine, or train, ..."),
    "--output": dict(type=Path, dest="folder", required=True, metavar="DIR", help="folder for all that is written"),
    "--plot": dict(type=Path, metavar="FILE", help="the paths from above and their errors (.png, .svg, .pdf, .jpg)"),
    "--json": dict(action="store_true", help="print JSON"),
    "--sequences": dict(nargs="+", action="extend", default=[], metavar="NN", help="those to run (all of ROOT)"),
    "--invert": dict(action="store_true", help="of --masks, keep what is 0 and ignore what is not"),
    "--dask": dict(metavar="ADDRESS", help="a Dask scheduler, tcp://host:8786, whose workers do it with the same bits"),
}
SEQUENCE, REQUIRED = ("--kitti", "--sequence", "--camera", "--frames"), {"required": True}
WIDTHS = dict(type=widths, nargs="+", action="extend", metavar="W")
MASKS = {
    "--boundaries": dict(metavar="canny|exact", default="canny", help="the thesis's, or every change of class"),
    "--symmetric": dict(action="store_true", help="masks in the middle of the boundaries, not half a pixel aside"),
    "--classes": dict(nargs="+", action="extend", default=[], metavar="NAME", help="boundaries of these classes alone"),
    "--without-movable": dict(type=int, nargs="?", const=0, metavar="PIXELS",
                              help="nothing on people and vehicles, nor so many pixels around them (0)"),
    "--keep": dict(metavar="boundaries|static|inverse|static-boundaries", default="boundaries", help="where keypoints "
                   "may lie: on boundaries, on what cannot move, on all but boundaries, on boundaries of the static"),
    "--ids": dict(metavar="labels|train", default="labels", help="of label maps: Cityscapes', or its train ids"),
    "--margin": dict(type=int, default=0, metavar="PIXELS", help="nothing along the frame's rim (0)"),
}


def build_parser():
    parser = _Parser(prog="thesis-repro", description="Keypoint masks from semantic segmentation for visual odometry")
    parser.add_argument("--version", action="version", version=f"thesis-repro {version('thesis-repro')}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    examples = (Path(__file__).parent / "report/templates/examples.txt").read_text(encoding="utf-8").splitlines()

    def command(function, *shared, **changed):
        """The parser of a command with options of SHARED; changed: what is other in one of them."""
        name = function.__name__.replace("_", "-")
        sub = commands.add_parser(
            name, help=function.__doc__, description=textwrap.fill(function.__doc__, 80),
            epilog="\n".join(line for line in examples if line.startswith(f"thesis-repro {name} ")),
            formatter_class=argparse.RawDescriptionHelpFormatter)
        sub.set_defaults(function=function)
        for name in shared:
            sub.add_argument(name, **(SHARED | MASKS)[name] | changed.get(name.strip("-"), {}))
        return sub

    add = command(synthesize).add_argument
    add("out", type=Path, metavar="OUT", help="folder to write, new or left unfinished before")
    add("--profile", choices=tuple(PROFILES), default="demo", help="size of the world (demo)")

    add = command(check_data, "--kitti", "--cityscapes").add_argument
    add("--kitti-semantic", type=Path, metavar="ROOT", help="folder that holds train and trainannot")
    add("--deep", action="store_true", help="decode every file, not only both ends of it, on all cores")

    add = command(predict, "--frames", "--dask", "--output").add_argument
    add("--images", type=Path, nargs="+", action="extend", required=True, metavar="DIR",
        help="folder of PNG or JPEG images, of a sequence, or KITTI's with all sequences; several get a folder each")
    add("--model", type=Path, nargs="+", action="extend", default=[], metavar="FILE",
        help="a trained model (.keras, .hdf5), several for their mean; without it the model in the package")

    add = command(masks, *SEQUENCE, *MASKS, "--output").add_argument
    add("--labels", type=Path, required=True, metavar="DIR", help="one label map a frame")
    add("--dilation", **WIDTHS, required=True, help="widths, pixels, as 10, 5,10 or 1-15; several get a folder each")

    sub = command(odometry, *SEQUENCE, *MASKS, "--invert", "--plot", "--json")
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    add("--speed", type=float, metavar="M_PER_S", help="metres a second without true poses (1 m a frame)")
    either("--masks", type=Path, metavar="DIR", help="one mask a frame, or one for all: 255 keep, 0 ignore")
    either("--labels", type=Path, metavar="DIR", help="one label map a frame, with --dilation")
    add("--dilation", type=int, metavar="W", help="dilation width in pixels of masks from label maps")
    add("--pyslam", choices=("2021", "2024"), default="2021", help="the thesis's PySLAM (2021), or a later one")
    add("--estimator", metavar="thesis|inliers|refined",
        help="all points vote on the motion (PySLAM); RANSAC's inliers vote; or it is fitted by least squares")
    add("--detector", metavar="shi-tomasi|orb", help="of keypoints; they are tracked all the same")
    add("--fallback", action="store_true", default=None, help="all keypoints where the masked ones tell no motion")
    add("--max-keypoints", type=int, metavar="N", help="most keypoints of a detection (2000)")
    add("--boresight", type=float, nargs=3, metavar=("PITCH", "YAW", "ROLL"),
        help="turn the path by the rotation between camera and truth, degrees; see the command boresight")
    add("--output", type=Path, metavar="POSES.txt", help="estimated poses in KITTI's form")
    add("--tum", type=Path, metavar="FILE", help="estimated poses in TUM's form")
    add("--video", type=Path, metavar="OUT.mp4", help="what the odometry sees and where it goes")

    command(boresight, "--kitti", "--sequences", "--frames", "--json", kitti=REQUIRED)

    sub = command(study, "--kitti", "--sequences", "--frames", "--invert", *MASKS, "--output", kitti=REQUIRED)
    add, either = sub.add_argument, sub.add_mutually_exclusive_group().add_argument
    for kind, what in (("labels", "a folder of label maps (Cityscapes ids, any size, named like the frames) for each "
                                  "sequence, DIR/NN; several times for several networks"),
                       ("masks", "the same with masks of the frames' size, 255 keep, 0 ignore")):
        add(f"--{kind}", dest="sources", action="append", metavar="DIR", help=what,
            type=lambda text, kind=kind: (kind, _path(text)))
    add("--name", action="append", default=[], metavar="NAME", help="of each --labels and --masks (the folder's)")
    add("--widths", **WIDTHS, help="dilation widths of masks from label maps, pixels, as 10, 5,10 or 1-15 (1-15)")
    add("--controls", type=int, nargs="?", const=10, metavar="W",
        help="masks and limits without segmentation, beside masks of width W (10)")
    add("--repetitions", type=int, default=5, metavar="N",
        help="of every run, each with the matched points shuffled in another way (5)")
    add("--estimator", nargs="+", choices=("thesis", "refined"), default=["thesis"], help="one (thesis) or both")
    either("--jobs", type=processes, metavar="N", help="processes at once (as many as there are cores)")
    either("--dask", **SHARED["--dask"])
    add("--plan", action="store_true", help="say what it would take, and run nothing")

    add = command(evaluate, "--kitti", "--sequence", "--frames", "--plot", "--json", sequence={
        "required": False, "help": "the sequence of files; of folders, the only one"}).add_argument
    add("poses", type=Path, nargs="+", metavar="FILE_OR_DIR",
        help="trajectories in KITTI's form (a line a frame) or TUM's (matched by time, keyframes will do), or folders "
             "with NN.txt for each sequence, which get a mean")
    add("--align", choices=("none", "se3", "sim3", "scale"), default="none",
        help="lay them over the truth for ATE, RPE (a frame), t_rel (%%) and r_rel (deg/100 m) (none)")

    command(plan, "--kitti", "--cityscapes", kitti=REQUIRED)
    return parser


def main(arguments=None):
    options = build_parser().parse_args(arguments)
    options.command_line = shlex.join(["thesis-repro", *(sys.argv[1:] if arguments is None else arguments)])
    try:
        with longrun.stoppable():
            longrun.need_addresses(4 if options.function is predict else 2)
            code = options.function(options) or 0
            sys.stdout.flush()
            return code
    except BrokenPipeError:  # whoever read this has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 128 + signal.SIGPIPE
    except Exception as error:
        return longrun.report_error(error)
    except KeyboardInterrupt as stop:
        with suppress(OSError):  # the terminal may be gone
            print("stopped; the same command goes on where it can", file=sys.stderr)
        return 128 + (stop.args[0] if stop.args else signal.SIGINT)
