"""The options of the command line. cli.py has the commands."""

import argparse
import os
import re
from collections.abc import Callable, Collection
from difflib import get_close_matches
from importlib.metadata import version
from pathlib import Path
from typing import Any

import shtab
from joblib import cpu_count

from thesis_repro.running import values


def path(text: str) -> Path:
    """Return a path. A shell replaces "~" only at the start of a word, not in --output=~/x."""
    return Path(os.path.expanduser(text))


# Options whose names stand in tables, which take a second to import: functions for `build_parser`.


def _profile() -> dict[str, Any]:
    import street_world

    return dict(choices=list(street_world.SIZES), default="demo", help="size of the world (demo)")


def _boundaries() -> dict[str, Any]:
    from thesis_repro.masks import BOUNDARIES

    return dict(
        metavar="|".join(BOUNDARIES),
        default="canny",
        help="edges by Canny or all changes of class (canny)",
    )


def _keep() -> dict[str, Any]:
    from thesis_repro.masks import KINDS

    where = ", ".join(kind.help for kind in KINDS.values())
    return dict(
        metavar="|".join(KINDS), default="boundaries", help=f"keypoints {where} (boundaries)"
    )


def _ids() -> dict[str, Any]:
    from thesis_repro.data.label_ids import LABEL_IDS, NAMES

    return dict(
        metavar="NAME|FILE",
        default=LABEL_IDS,
        help=f"ids or colours that label maps hold: {', '.join(NAMES)}, or a table with lines such as "
        "34,building or #464646,building (labels)",
    )


def _detector() -> dict[str, Any]:
    from thesis_repro.odometry.keypoints import DETECTORS

    words = []
    for name, detector in DETECTORS.items():
        shown = f"{name}=N" if isinstance(detector, type) else name
        first_line = (detector.__doc__ or "").splitlines()[0].rstrip(".").replace("%", "%%")
        words.append(f"{shown}: {first_line}")
    return dict(
        type=detector_of,
        metavar="NAME[=N]",
        default="shi-tomasi",
        help=f"what finds keypoints: {'; '.join(words)} (shi-tomasi)",
    )


def detector_of(text: str) -> Callable | None:
    """Return the detector that a text names, such as "orb" or "spread=200"; None: the thesis's."""
    from thesis_repro.odometry.keypoints import DETECTORS

    name, equals, number = text.partition("=")
    if text == "shi-tomasi":
        return None
    if name not in DETECTORS or isinstance(DETECTORS[name], type) != bool(equals):
        known = ", ".join(["shi-tomasi", *DETECTORS])
        raise argparse.ArgumentTypeError(f"{text}: is none of {known}, or lacks its number")
    return DETECTORS[name](int(number)) if equals else DETECTORS[name]


def _estimator() -> dict[str, Any]:
    from thesis_repro.odometry.estimators import ESTIMATORS

    titles = "; ".join(f"{name}: {entry.title}" for name, entry in ESTIMATORS.items())
    return dict(
        choices=list(ESTIMATORS),
        default="thesis",
        help=f"what estimates a motion: {titles} (thesis)",
    )


def _estimators() -> dict[str, Any]:
    from thesis_repro.odometry.estimators import COMPARED

    words = f"one or several ({' '.join(COMPARED)})"
    return _estimator() | dict(nargs="+", default=list(COMPARED), help=words)


# options of several commands, as arguments of argparse's `add_argument`
SHARED: dict[str, dict[str, Any]] = {
    "--kitti": dict(
        type=path,
        metavar="ROOT",
        help="KITTI folder, with sequences/ and poses/, or with raw drives",
    ),
    "--sequence": dict(
        required=True,
        metavar="NN",
        help="00 to 21, or without --kitti a folder: a raw drive of KITTI, EuRoC, TUM RGB-D, or your own frames",
    ),
    "--frames": dict(
        type=values.number_of_frames,
        metavar="N|all",
        help="use the first N frames of a sequence (all)",
    ),
    "--camera": dict(
        metavar="image_N",
        help="folder of the frames (image_0, or else image_2, read as gray; in raw drives image_00; in EuRoC cam0)",
    ),
    "--output": dict(
        type=path, dest="folder", required=True, metavar="DIR", help="folder for all results"
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
    "--dilation": dict(
        type=int, metavar="W", help="dilation width, in pixels, of masks from label maps"
    ),
    "--calibration": dict(
        type=path,
        metavar="FILE",
        help="camera with distortion, which is taken out: fx fy cx cy k1 k2 p1 p2 (the first four are enough), or "
        "YAML of OpenCV, ROS, EuRoC or Kalibr (that of the layout, such as calib.txt)",
    ),
}
SEQUENCE = ("--kitti", "--sequence", "--camera", "--calibration", "--frames")

MASK_OPTIONS: dict[str, Any] = {
    "--boundaries": _boundaries,
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
    "--keep": _keep,
    "--ids": _ids,
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
        help=f"{content} (NAME: the folder's; can be repeated)",
    )


def _name_and_folder(text: str) -> tuple[str | None, Path]:
    """Return the name and the folder of NAME=FOLDER; no name for a folder alone.

    A path may have "=" in it: it is no name if it holds "/", or if there is a folder of that path.
    """
    name, equals, folder = text.partition("=")
    if not equals or "/" in name or Path(text).is_dir():
        whole = path(text)
        if whole.is_symlink():  # the name that was typed, not that of its target
            return re.sub(r"[^\w+-]+", "-", whole.name).strip("-") or None, whole
        return None, whole
    return name, path(folder)


# the arguments of `add_argument` for each option of each command, or a function that returns them
COMMANDS: dict[str, dict[str, Any]] = {
    "synthesize": {
        "out": dict(
            type=path, metavar="OUT", help="new folder, or one in which this command was stopped"
        ),
        "--profile": _profile,
    },
    "check-data": {
        **_shared("--kitti"),
        "--cityscapes": dict(
            type=path,
            metavar="ROOT",
            help="Cityscapes folder (leftImg8bit/, gtFine/ or train/, ...)",
        ),
        "--kitti-semantic": dict(
            type=path, metavar="ROOT", help="folder of KITTI's street scenes: train/, trainannot/"
        ),
    },
    "predict": {
        **_shared("--frames", "--output"),
        "--images": dict(
            type=path,
            required=True,
            metavar="DIR",
            help="folder of PNG or JPEG images, one sequence, or a folder of sequences, which get a subfolder each",
        ),
        **_shared("--camera", "--calibration"),
        "--model": dict(
            type=path,
            metavar="FILE",
            help="trained model, .keras or .hdf5 (the model in the package)",
        ),
        "--scale": dict(
            type=values.positive_factor,
            default=1,
            metavar="FACTOR",
            help="multiply gray values, 0 to 255, by this; 1/255 for a model that wants 0 to 1 (1)",
        ),
        "--preprocess": dict(
            choices=["tf", "torch", "caffe"],
            help="instead of --scale, what Keras' applications want: tf for -1 to 1; torch and caffe take out "
            "ImageNet's mean colour",
        ),
    },
    "masks": {
        **_shared(*SEQUENCE),
        **MASK_OPTIONS,
        **_shared("--output"),
        "--labels": dict(
            type=path,
            required=True,
            metavar="DIR",
            help="a label map for each frame, or a folder of them for each sequence",
        ),
        **_shared("--dilation"),
    },
    "odometry": {
        **_shared(*SEQUENCE),
        **MASK_OPTIONS,
        **_shared("--invert", "--scale-gate", "--spread", "--fill"),
        "--truth": dict(
            type=path,
            metavar="FILE",
            help="true camera-to-world poses in KITTI's, TUM's or EuRoC's format (poses/NN.txt, or poses.txt "
            "beside the frames)",
        ),
        "--truth-within": dict(
            type=float,
            metavar="SECONDS",
            default=0.01,
            help="how far the true pose of a frame may be in time; frames without one are left out (0.01, as in evo)",
        ),
        "--speed": dict(
            type=float,
            metavar="M_PER_S",
            help="speed, in place of ground truth (without both, 1 m a frame)",
        ),
        "--fps": dict(
            type=float, metavar="N", help="frames a second, if there is no times.txt (10)"
        ),
        "--masks": dict(
            type=path,
            metavar="DIR",
            help="a mask for each frame or one for all: 255 keep, 0 ignore; or a folder for each sequence",
        ),
        "--labels": dict(
            type=path,
            metavar="DIR",
            help="a label map for each frame, or a folder of them for each sequence; needs --dilation",
        ),
        **_shared("--dilation"),
        "--estimator": _estimator,
        "--detector": _detector,
        "--max-keypoints": dict(
            type=int,
            default=2000,
            metavar="N",
            help="maximum number of keypoints in a frame (2000)",
        ),
        "--output": dict(
            type=path, metavar="POSES.txt", help="write the estimated poses in KITTI format"
        ),
        "--tum": dict(type=path, metavar="FILE", help="write the estimated poses in TUM format"),
        "--plot": dict(
            type=path,
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
        **_shared("--frames", "--invert", "--scale-gate", "--spread", "--fill"),
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
            "Python file, which is executed, with your detect(frame, settings, mask), "
            "track(previous, current, points, settings), or others of the odometry's four calls",
        ),
        "--widths": dict(
            type=values.list_of_widths,
            nargs="+",
            action="extend",
            default=[],
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
        "--estimator": _estimators,
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


class _Parser(argparse.ArgumentParser):
    """A parser of one command, which names the option that a misspelled one may stand for."""

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        for word in args:
            name = word.partition("=")[0]
            close = get_close_matches(name, self._option_string_actions)
            if name.startswith("--") and close and close[0] != name:
                self.error(f"{name}: no such option; did you mean {close[0]}?")
        return super().parse_known_args(args, namespace)


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
    shtab.add_argument_to(parser, help="print what completes commands and options in this shell")
    commands = parser.add_subparsers(
        dest="command", metavar="COMMAND", required=True, parser_class=_Parser
    )
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
        if arguments is not None and not {name, "--print-completion"} & set(arguments):
            continue
        for option, how in COMMANDS[name].items():
            group: Any = sub
            if option in MASK_OPTIONS:
                group = mask_options
            added = group.add_argument(option, **(how() if callable(how) else how))
            if added.type is path:
                added.complete = shtab.FILE
    return parser
