"""The options of the command line. cli.py has the commands."""

import argparse
import textwrap
from functools import partial
from importlib.metadata import version
from pathlib import Path

from thesis_repro import InputError, one_line
from thesis_repro.settings import PROFILES, number, read_frames, read_widths, scheduler_address


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


def build_parser(functions):
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
    examples = (
        (Path(__file__).parent / "report/templates/examples.txt")
        .read_text(encoding="utf-8")
        .splitlines()
    )

    def command(name, *shared, **changes):
        """Add the parser of a command with options of SHARED and MASK_OPTIONS. changes: arguments
        that differ, by option.
        """
        function = functions[name]
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

    add = command("synthesize").add_argument
    add(
        "out", type=Path, metavar="OUT", help="new folder, or one in which this command was stopped"
    )
    add("--profile", choices=tuple(PROFILES), default="demo", help="size of the world (demo)")

    add = command("check-data", "--kitti", "--cityscapes").add_argument
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

    add = command("predict", "--frames", "--dask", "--output").add_argument
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
        metavar="FILE",
        help="trained model, .keras or .hdf5 (the model in the package)",
    )

    add = command("masks", *SEQUENCE, *MASK_OPTIONS, "--output").add_argument
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

    sub = command("odometry", *SEQUENCE, *MASK_OPTIONS, "--invert", "--plot", "--json")
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
        "study",
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

    add = command(
        "evaluate",
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
    return parser
