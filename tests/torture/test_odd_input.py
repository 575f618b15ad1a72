"""Odd names, no network and a read-only cache must work; data must not be changed."""

import ctypes
import os
import shutil
import subprocess

import pytest
import trials

pytestmark = pytest.mark.torture

ODD = 'it\'s "50%" <script>&$x$_ é漢\n{b} #[1]*'
SEQUENCE = "<b>&\"'$_$ %s é"


def without_network():
    """Take the network from a process, which only root may do."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).unshare(0x40000000)  # CLONE_NEWNET


def without_root_privileges():
    """Drop the capabilities of root that ignore permissions of files."""
    if os.geteuid() == 0:
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def test_odd_names_and_no_network_work_and_data_is_only_read(folder, tmp_path):
    root = tmp_path / ODD
    root.mkdir()
    out, labels = root / 'out %d "x"', (folder / "labels").rename(root / "labels <i>&")
    (folder / "kitti").rename(root / "kitti")
    (root / "kitti/sequences/00").rename(root / "kitti/sequences" / SEQUENCE)
    (root / "kitti/poses/00.txt").rename(root / f"kitti/poses/{SEQUENCE}.txt")
    where = ["--kitti", root / "kitti", "--sequence", SEQUENCE]
    before = trials.snapshot(root / "kitti"), trials.snapshot(labels)
    for words in (
        [
            "odometry",
            *where,
            "--labels",
            labels,
            "--dilation",
            3,
            "--output",
            out / "p'$_$.txt",
            "--tum",
            out / "%s\n.tum",
            "--plot",
            out / "%d.svg",
            "--video",
            out / "%03d é.webm",
        ],
        ["masks", *where, "--labels", labels, "--dilation", 3, "--output", out / "masks\n&"],
        [
            "odometry",
            *where,
            "--masks",
            out / "masks\n&",
            "--output",
            out / "q<script>.txt",
            "--plot",
            out / "$_$.png",
        ],
        ["evaluate", *where, out / "p'$_$.txt", out / "q<script>.txt", "--plot", out / "both.svg"],
        ["check-data", "--kitti", root / "kitti", "--deep"],
        [
            "study",
            "--kitti",
            root / "kitti",
            "--labels",
            labels,
            "--masks",
            out / "masks\n&",
            "--repetitions",
            1,
            "--widths",
            2,
            3,
            "--jobs",
            1,
            "--controls",
            3,
            "--output",
            out / "study",
        ],
        [
            "predict",
            "--images",
            root / "kitti/sequences" / SEQUENCE,
            "--output",
            out / "labels {2}",
        ],
        ["synthesize", out / "world", "--profile", "smoke"],
    ):
        trials.succeed(trials.thesis(*words), tmp_path, before=without_network)
        assert (trials.snapshot(root / "kitti"), trials.snapshot(labels)) == before, words
    assert {path.name for path in out.iterdir()} == {
        "p'$_$.txt",
        "%s\n.tum",
        "%d.svg",
        "%03d é.webm",
        "masks\n&",
        "q<script>.txt",
        "$_$.png",
        "both.svg",
        "study",
        "labels {2}",
        "world",
    }
    page = (out / "study" / "index.html").read_text()
    assert "&lt;b&gt;&amp;" in page and "&lt;i&gt;&amp;" in page
    assert not any(tag in page for tag in ("<script", "<b>", "<i>"))


def test_make_takes_odd_folders_and_refuses_unknown_settings(tiny_kitti, tmp_path):
    # make expands $ and ends at a line break
    odd = tmp_path / ODD.replace("$x$_", "").replace("\n", " ")
    tiny_kitti.rename(odd)

    def make(*words):
        return subprocess.run(
            ["make", "-C", trials.ROOT, "-o", ".venv/ready", *words],
            capture_output=True,
            text=True,
            env=trials.environment(),
        )

    assert make("check-data", f"KITTI={odd}").returncode == 0
    planned = make("-n", "figures", "PROFILE=smoke", f"KITTI={odd}", f"BUILD={tmp_path / 'build'}")
    assert (
        planned.returncode == 0 and f"{tmp_path / 'build'}/kitti-it-s-50-script-" in planned.stdout
    ), planned
    for target, word, named in (
        ("figures", "EPOCHS=0", "EPOCHS=0: "),
        ("figures", "EPOCH=3", "EPOCH: "),
        ("figures", "KITTI=", "KITTI"),
        ("figures", "GPU=no", "GPU=no"),
        ("figures", "PYTHON=none", "none is no Python"),
        ("figures", "FIGURES=a b", "FIGURES"),
        ("figures", "DASK_SCHEDULER=mine", "mine"),
        ("weights", f"CAMVID={odd}", "KITTI_SEMANTIC"),
        ("weights", f"KITTI_SEMANTIC={odd}", "CAMVID"),
    ):
        refused = make(target, word, f"BUILD={tmp_path / 'other'}")
        assert refused.returncode != 0 and not (tmp_path / "other").exists(), refused
        assert named in refused.stderr and "Traceback" not in refused.stderr, refused


def test_caches_that_cannot_be_written(tmp_path, tiny_kitti):
    package, home = tmp_path / "package" / "thesis_repro", tmp_path / "home"
    shutil.copytree(
        trials.ROOT / "thesis_repro", package, ignore=shutil.ignore_patterns("__pycache__")
    )
    home.mkdir()
    folders = [home, package.parent, package, *package.rglob("*/")]
    for folder in folders:
        folder.chmod(0o555)
    no_caches = dict.fromkeys(
        ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR", "KERAS_HOME")
    )
    for words, output in (
        ("odometry --kitti kitti --sequence 00 --plot path.png", "path.png"),
        ("predict --images kitti/sequences/00 --output out", "out"),
    ):
        result = trials.succeed(
            trials.thesis(*words.split()),
            tmp_path,
            before=without_root_privileges,
            PYTHONPATH=package.parent,
            HOME=home,
            **no_caches,
        )
        assert {path.split("/")[0] for path in result.left} == {
            output
        } and "Traceback" not in result.stderr
    for folder in folders:
        folder.chmod(0o755)
