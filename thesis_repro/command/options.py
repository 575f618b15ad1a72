"""The options of the command line. cli.py has the commands."""

import argparse
import shlex
import textwrap
from collections.abc import Callable
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, NoReturn

from thesis_repro.errors import InputError, one_line
from thesis_repro.running.settings import (
    PROFILES,
    number,
    read_frames,
    read_widths,
    scheduler_address,
)


class _Parser(argparse.ArgumentParser):
    """An ArgumentParser with one-line errors and without abbreviated options.

    It refuses empty paths.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__(allow_abbrev=False, **options)
        self.register("type", Path, _path)

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"error: {one_line(message)}; see {self.prog} --help\n")


def _path(text: str) -> Path:
    if not text.strip():
        raise argparse.ArgumentTypeError("is empty; name a file or a folder")
    return Path(text)


def _setting(read: Callable[[str], Any]) -> Callable[[str], Any]:
    """Let argparse show the InputError of a function that reads an option.

    By itself it would say "invalid value".
    """

    def read_text(text: str) -> Any:
        try:
            return read(text)
        except InputError as error:
            raise argparse.ArgumentTypeError(error) from None

    return read_text


def _compared_estimator(text: str) -> str:
    from thesis_repro.study.jobs import ESTIMATORS  # here, because this import takes a second

    if text not in ESTIMATORS:
        raise InputError(f"{text!r} is unknown; choose one of {', '.join(ESTIMATORS)}")
    return text


# options of several commands
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
SEQUENCE = ("--kitti", "--sequence", "--camera", "--frames")
WIDTHS = dict(type=_setting(read_widths), nargs="+", action="extend", metavar="W,W")
MASK_OPTIONS: dict[str, dict[str, Any]] = {
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


def _shared(*names: str) -> dict[str, dict[str, Any]]:
    return {name: SHARED[name] for name in names}


def _source(kind: str, content: str) -> dict[str, Any]:
    """Return the arguments of an option that adds a source of masks to a study."""
    return dict(
        dest="sources",
        action="append",
        metavar="[NAME=]DIR",
        type=lambda text: (kind, *_name_and_folder(text)),
        help=f"folder with a subfolder NN for each sequence ({content}), and a name for it (the folder's); "
        "can be repeated",
    )


def _name_and_folder(text: str) -> tuple[str | None, Path]:
    """Return the name and the folder of NAME=FOLDER; no name for a folder alone.

    A path may have "=" in it: it is no name if it holds "/", or if there is a folder of that path.
    """
    name, equals, folder = text.partition("=")
    if not equals or "/" in name or Path(text).is_dir():
        return None, _path(text)
    # a shell replaces "~" only at the start of a word
    return name, _path(folder).expanduser()


def _refuse_name(text: str) -> NoReturn:
    """Raise InputError for the option --name, which had to stand in the order of the folders."""
    raise InputError(
        f"a name stands before its folder now: --labels {shlex.quote(text)}=FOLDER, "
        f"or --masks {shlex.quote(text)}=FOLDER"
    )


# the arguments of `add_argument` for each option of each command
COMMANDS: dict[str, dict[str, dict[str, Any]]] = {
    "synthesize": {
        "out": dict(
            type=Path, metavar="OUT", help="new folder, or one in which this command was stopped"
        ),
        "--profile": dict(choices=tuple(PROFILES), default="demo", help="size of the world (demo)"),
    },
    "check-data": {
        **_shared("--kitti", "--cityscapes"),
        "--kitti-semantic": dict(
            type=Path, metavar="ROOT", help="folder of KITTI's street scenes: train/, trainannot/"
        ),
        "--deep": dict(
            action="store_true",
            help="decode every file, on all cores, not only check its header and end",
        ),
    },
    "predict": {
        **_shared("--frames", "--dask", "--output"),
        "--images": dict(
            type=Path,
            nargs="+",
            action="extend",
            required=True,
            metavar="DIR",
            help="folder of PNG or JPEG images, one sequence, or a folder of sequences; several get a subfolder each",
        ),
        "--model": dict(
            type=Path,
            metavar="FILE",
            help="trained model, .keras or .hdf5 (the model in the package)",
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
        "--dilation": dict(
            **WIDTHS, help="in pixels, such as 5,10 or 1-15; several get a subfolder each"
        ),
    },
    "odometry": {
        **_shared(*SEQUENCE),
        **MASK_OPTIONS,
        **_shared("--invert", "--plot", "--json"),
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
        "--dilation": dict(
            type=int, metavar="W", help="dilation width, in pixels, of masks from label maps"
        ),
        "--estimator": dict(
            metavar="thesis|inliers|refined",
            help="motion by a vote of all matched points (PySLAM) or of RANSAC's inliers, or by least squares (thesis)",
        ),
        "--detector": dict(
            metavar="shi-tomasi|orb",
            help="keypoint detector; the tracker stays the same (shi-tomasi)",
        ),
        "--fallback": dict(
            action="store_true", default=None, help="use all keypoints where masked ones fail"
        ),
        "--max-keypoints": dict(
            type=int, metavar="N", help="maximum number of keypoints in a frame (2000)"
        ),
        "--output": dict(
            type=Path, metavar="POSES.txt", help="write the estimated poses in KITTI format"
        ),
        "--tum": dict(type=Path, metavar="FILE", help="write the estimated poses in TUM format"),
        "--video": dict(
            type=Path,
            metavar="OUT.webm",
            help="write a video of the frames, the keypoints and the path",
        ),
    },
    "study": {
        "--kitti": SHARED["--kitti"] | {"required": True},
        **_shared("--sequences", "--frames", "--invert"),
        **MASK_OPTIONS,
        **_shared("--output"),
        "--labels": _source("labels", "label maps, any size"),
        "--masks": _source("masks", "masks, 255 keeps keypoints, 0 ignores them"),
        "--name": dict(type=_setting(_refuse_name), help=argparse.SUPPRESS),
        "--widths": dict(
            **WIDTHS,
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
            type=int, default=5, metavar="N", help="shuffles of the matched points for each run (5)"
        ),
        "--estimator": dict(
            nargs="+",
            type=_setting(_compared_estimator),
            metavar="thesis|refined",
            default=["thesis"],
            help="one or both (thesis)",
        ),
        "--jobs": dict(
            type=_setting(partial(number, "JOBS")),
            metavar="N",
            help="number of processes (number of cores)",
        ),
        **_shared("--dask"),
    },
}
# of these options, only one may be given
EXCLUSIVE = {"odometry": ("--masks", "--labels"), "study": ("--jobs", "--dask")}


def build_parser(functions: dict[str, Callable]) -> argparse.ArgumentParser:
    """Return the parser. functions: of the commands, by name; their docstrings are the help."""
    parser = _Parser(
        prog="thesis-repro",
        description="Keypoint masks from semantic segmentation for monocular visual "
        "odometry. thesis-repro COMMAND --help shows options, with defaults in parentheses, and examples.",
    )
    parser.add_argument(
        "--version", action="version", version=f"thesis-repro {version('thesis-repro')}"
    )
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    examples = Path(__file__).with_name("examples.txt").read_text(encoding="utf-8").splitlines()
    for name, function in functions.items():
        # python -OO leaves docstrings out
        description = " ".join((function.__doc__ or "").split())
        own_examples = [line for line in examples if line.startswith(f"thesis-repro {name} ")]
        sub = commands.add_parser(
            name,
            help=description,
            description=textwrap.fill(description, 80),
            epilog="\n".join(["examples:", *own_examples]),
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        sub.set_defaults(function=function)
        exclusive_names: tuple[str, ...] = ()
        if name in EXCLUSIVE:
            exclusive_names = EXCLUSIVE[name]
            exclusive = sub.add_mutually_exclusive_group()
        mask_options = sub.add_argument_group("how masks are made from label maps")
        for option, arguments in COMMANDS[name].items():
            if option in MASK_OPTIONS:
                mask_options.add_argument(option, **arguments)
            elif option in exclusive_names:
                exclusive.add_argument(option, **arguments)
            else:
                sub.add_argument(option, **arguments)
    return parser
