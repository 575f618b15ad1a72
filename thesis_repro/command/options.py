"""The options of the command line. cli.py has the commands."""

import argparse
from collections.abc import Callable, Collection
from fractions import Fraction
from importlib.metadata import version
from pathlib import Path
from typing import Any

from joblib import cpu_count

from thesis_repro.running import values

# options of several commands, as arguments of argparse's `add_argument`
SHARED: dict[str, dict[str, Any]] = {
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
        type=values.number_of_frames,
        metavar="N|all",
        help="use the first N frames of a sequence (all)",
    ),
    "--camera": dict(
        metavar="image_N",
        help="folder of the frames (image_0, or else image_2, read as gray; in a raw drive image_00, ...)",
    ),
    "--output": dict(
        type=Path, dest="folder", required=True, metavar="DIR", help="folder for all results"
    ),
    "--invert": dict(
        action="store_true", help="for --masks in which 0 keeps and other values ignore keypoints"
    ),
    "--scale-gate": dict(
        type=float,
        default=0.1,
        metavar="METRES",
        help="a shorter step leaves the pose as it is; 0 for slow cameras and many frames a second (0.1)",
    ),
    "--without-border": dict(
        action="store_true",
        help="no keypoints in and near parts that are black in all frames, as undistortion leaves them (transparent "
        "parts never have any)",
    ),
    "--spread": dict(
        type=values.positive_whole_number,
        metavar="N",
        help="N keypoints, as far apart as their number allows, in place of the 2000 strongest (with study: in "
        "runs with masks)",
    ),
    "--fill": dict(
        type=values.positive_whole_number,
        metavar="N",
        help="fill each of 16 x 5 fields of the frame to N keypoints where the mask leaves fewer",
    ),
}
SEQUENCE = ("--kitti", "--sequence", "--camera", "--frames")
DILATION = dict(type=int, metavar="W", help="dilation width, in pixels, of masks from label maps")


NAMED: dict[str, Any] = {}  # see `named`
MASK_OPTIONS: dict[str, dict[str, Any]] = {
    "--boundaries": NAMED,
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
    "--keep": NAMED,
    "--ids": dict(
        metavar="labels|train|colors|FILE",
        default="labels",
        help="label maps hold Cityscapes' label ids, train ids or colours, or those of a table with lines such "
        "as 34,building or #464646,building (labels)",
    ),
    "--margin": dict(
        type=int, default=0, metavar="PIXELS", help="no keypoints near the frame's border (0)"
    ),
}


def _shared(*names: str) -> dict[str, dict[str, Any]]:
    return {name: SHARED[name] for name in names}


def _source(kind: str, form: str, content: str) -> dict[str, Any]:
    """Return the arguments of an option that adds a source to a study."""
    return dict(
        dest="sources",
        action="append",
        metavar=form,
        type=lambda text: (kind, *_name_and_folder(text)),
        help=f"{content}, and a name for it (the folder's); can be repeated",
    )


def _name_and_folder(text: str) -> tuple[str | None, Path]:
    """Return the name and the folder of NAME=FOLDER; no name for a folder alone.

    A path may have "=" in it: it is no name if it holds "/", or if there is a folder of that path.
    """
    name, equals, folder = text.partition("=")
    if not equals or "/" in name or Path(text).is_dir():
        return None, Path(text)
    return name, Path(folder).expanduser()  # a shell replaces "~" only at the start of a word


# the arguments of `add_argument` for each option of each command
COMMANDS: dict[str, dict[str, dict[str, Any]]] = {
    "synthesize": {
        "out": dict(
            type=Path, metavar="OUT", help="new folder, or one in which this command was stopped"
        ),
        "--profile": NAMED,
    },
    "check-data": {
        **_shared("--kitti"),
        "--cityscapes": dict(
            type=Path,
            metavar="ROOT",
            help="Cityscapes folder (leftImg8bit/, gtFine/ or train/, ...)",
        ),
        "--kitti-semantic": dict(
            type=Path, metavar="ROOT", help="folder of KITTI's street scenes: train/, trainannot/"
        ),
    },
    "predict": {
        **_shared("--frames", "--output"),
        "--images": dict(
            type=Path,
            required=True,
            metavar="DIR",
            help="folder of PNG or JPEG images, one sequence, or a folder of sequences, which get a subfolder each",
        ),
        "--model": dict(
            type=Path,
            metavar="FILE",
            help="trained model, .keras or .hdf5 (the model in the package)",
        ),
        "--scale": dict(
            type=Fraction,
            default=1,
            metavar="FACTOR",
            help="multiply gray values, 0 to 255, by this; 1/255 for a model that wants 0 to 1 (1)",
        ),
    },
    "masks": {
        **_shared(*SEQUENCE),
        **MASK_OPTIONS,
        **_shared("--output"),
        "--labels": dict(
            type=Path,
            required=True,
            metavar="DIR",
            help="a label map for each frame, or a folder of them for each sequence",
        ),
        "--dilation": DILATION,
    },
    "odometry": {
        **_shared(*SEQUENCE),
        **MASK_OPTIONS,
        **_shared("--invert", "--scale-gate", "--without-border", "--spread", "--fill"),
        "--truth": dict(
            type=Path,
            metavar="FILE",
            help="true camera-to-world poses in KITTI's, TUM's or EuRoC's format (poses/NN.txt, or poses.txt "
            "beside the frames)",
        ),
        "--calibration": dict(
            type=Path,
            metavar="FILE",
            help="camera with distortion, which is taken out: fx fy cx cy k1 k2 p1 p2 (the first four are "
            "enough), or YAML of OpenCV, ROS, EuRoC, Kalibr or ORB-SLAM (calib.txt, without distortion)",
        ),
        "--speed": dict(
            type=float, metavar="M_PER_S", help="speed, if there is no ground truth (1 m a frame)"
        ),
        "--fps": dict(
            type=float, metavar="N", help="frames a second, if there is no times.txt (10)"
        ),
        "--masks": dict(
            type=Path,
            metavar="DIR",
            help="a mask for each frame or one for all: 255 keep, 0 ignore; or a folder for each sequence",
        ),
        "--labels": dict(
            type=Path,
            metavar="DIR",
            help="a label map for each frame, or a folder of them for each sequence; needs --dilation",
        ),
        "--dilation": DILATION,
        "--estimator": NAMED,
        "--detector": NAMED,
        "--max-keypoints": dict(
            type=int,
            default=2000,
            metavar="N",
            help="maximum number of keypoints in a frame (2000)",
        ),
        "--output": dict(
            type=Path, metavar="POSES.txt", help="write the estimated poses in KITTI format"
        ),
        "--tum": dict(type=Path, metavar="FILE", help="write the estimated poses in TUM format"),
        "--plot": dict(
            type=Path,
            metavar="FILE",
            help="draw the paths and their errors (.png, .svg, .pdf, .jpg)",
        ),
        "--json": dict(action="store_true", help="print JSON instead of text"),
    },
    "study": {
        "--kitti": SHARED["--kitti"] | {"required": True},
        "--sequences": dict(
            nargs="+",
            action="extend",
            default=[],
            metavar="NN",
            help="sequences to run (all in ROOT)",
        ),
        **_shared("--frames", "--invert", "--scale-gate", "--without-border", "--spread", "--fill"),
        **MASK_OPTIONS,
        **_shared("--output"),
        "--labels": _source(
            "labels",
            "[NAME=]DIR[:IDS]",
            "folder with a subfolder NN of label maps for each sequence, with these ids instead of those that "
            "--ids names",
        ),
        "--masks": _source(
            "masks",
            "[NAME=]DIR",
            "folder with a subfolder NN of masks for each sequence, 255 keeps keypoints, 0 ignores them",
        ),
        "--keypoints": _source(
            "keypoints",
            "[NAME=]FILE.py",
            "Python file, which is executed, with your function detect(frame, settings, mask), "
            "track(previous, current, points, settings), or others of the odometry's four calls",
        ),
        "--paths": _source(
            "paths",
            "[NAME=]DIR",
            "folder with the path NN.txt of another system for each sequence, in KITTI's or TUM's format, metres",
        ),
        "--widths": dict(
            type=values.list_of_widths,
            nargs="+",
            action="extend",
            metavar="W,W",
            help="dilation widths of masks from label maps, in pixels, such as 5,10 (1-15)",
        ),
        "--controls": dict(
            type=int,
            nargs="?",
            const=10,
            metavar="W",
            help="run controls, too, for masks of width W (10)",
        ),
        "--repetitions": dict(
            type=values.positive_whole_number,
            default=5,
            metavar="N",
            help="shuffles of the matched points for each run (5)",
        ),
        "--estimator": NAMED,
        "--jobs": dict(
            type=values.positive_whole_number,
            default=cpu_count(),
            metavar="N",
            help="number of processes (number of cores)",
        ),
        "--dask": dict(
            metavar="ADDRESS",
            help="run on the workers of a Dask scheduler, tcp://host:8786, with the same results",
        ),
    },
}


def named(command: str) -> dict[str, dict[str, Any]]:
    """Return the options whose names stand in tables, which take a second to import."""
    if command == "synthesize":
        import street_world

        sizes = list(street_world.SIZES)
        return {"--profile": dict(choices=sizes, default="demo", help="size of the world (demo)")}
    from thesis_repro.masks import BOUNDARIES, KINDS
    from thesis_repro.odometry.estimators import COMPARED, ESTIMATORS
    from thesis_repro.odometry.keypoints import DETECTORS

    where = ", ".join(kind.help for kind in KINDS.values())
    titles = "; ".join(f"{name}: {entry.title}" for name, entry in ESTIMATORS.items())
    detectors = {
        name: f"{name}: {detector.__doc__}".splitlines()[0].rstrip(".").replace("%", "%%")
        for name, detector in DETECTORS.items()
        if not isinstance(detector, type)  # it needs a number
    }
    estimators: dict[str, Any] = dict(
        choices=list(ESTIMATORS),
        default="thesis",
        help=f"what estimates a motion: {titles} (thesis)",
    )
    if command == "study":
        default = " ".join(COMPARED)
        estimators |= dict(nargs="+", default=list(COMPARED), help=f"one or several ({default})")
    return {
        "--boundaries": dict(
            metavar="|".join(BOUNDARIES),
            default="canny",
            help="edges by Canny or all changes of class (canny)",
        ),
        "--keep": dict(
            metavar="|".join(KINDS), default="boundaries", help=f"keypoints {where} (boundaries)"
        ),
        "--estimator": estimators,
        "--detector": dict(
            choices=["shi-tomasi", *detectors],
            default="shi-tomasi",
            help=f"what finds keypoints: {'; '.join(detectors.values())} (shi-tomasi)",
        ),
    }


def build_parser(
    functions: dict[str, Callable], arguments: Collection[str] | None = None
) -> argparse.ArgumentParser:
    """Return the parser of arguments. functions: of the commands, by name.

    Their docstrings are the help. Only the command in the arguments gets its options; without
    arguments, all do.
    """
    parser = argparse.ArgumentParser(
        prog="thesis-repro",
        description="Keypoint masks from semantic segmentation for monocular visual odometry. "
        "thesis-repro COMMAND --help shows options, with defaults in parentheses, and examples.",
        allow_abbrev=False,
    )
    parser.add_argument(
        "--version", action="version", version=f"thesis-repro {version('thesis-repro')}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    examples = Path(__file__).with_name("examples.txt").read_text(encoding="utf-8").splitlines()
    for name, function in functions.items():
        own_examples = [line for line in examples if line.startswith(f"thesis-repro {name} ")]
        sub = commands.add_parser(
            name,
            help=function.__doc__,
            description=function.__doc__,
            epilog="\n".join(["examples:", *own_examples]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
        )
        sub.set_defaults(function=function)
        mask_options = sub.add_argument_group("how masks are made from label maps")
        if arguments is not None and name not in arguments:
            continue
        for option, how in COMMANDS[name].items():
            group: Any = sub
            if option in MASK_OPTIONS:
                group = mask_options
            group.add_argument(option, **(how or named(name)[option]))
    return parser
