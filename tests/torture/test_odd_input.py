"""Odd input that must work: names of every kind, a home that may not be written to; and what a run must not touch."""

import ctypes
import hashlib
import os
import shutil
import subprocess

import cv2
import numpy as np
import pytest
import trials

ODD = "it's \"50%\" <script>&$x$_ é漢\n{b} #[1]*"
SEQUENCE = "<b>&\"'$_$ %s é"
CLONE_NEWNET = 0x40000000  # Linux's word for a network of one's own


def sequence(root, name, count=8):
    """A sequence of noise that moves, its label maps and masks in folders with names as odd as its own."""
    images = root / "kitti" / "sequences" / name / "image_0"
    noise = np.random.default_rng(0).integers(0, 256, (48, 80), np.uint8)
    for folder in (images, root / "labels <i>&", root / "masks", root / "kitti/poses"):
        folder.mkdir(parents=True)
    labels, mask = np.full((32, 40), [[7]] * 16 + [[23]] * 16), np.full((48, 64), [0] * 32 + [255] * 32)
    for index in range(count):
        cv2.imwrite(str(images / f"{index:06d}.png"), noise[:, index:index + 64])
        cv2.imwrite(str(root / "labels <i>&" / f"{index:06d}.png"), labels.astype(np.uint8))
        cv2.imwrite(str(root / "masks" / f"{index:06d}.png"), mask.astype(np.uint8))
    (images.parent / "calib.txt").write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    (root / f"kitti/poses/{name}.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {index}\n" for index in range(count)))


def digests(*folders):
    """What is in every file below some folders, and what every link points to."""
    return {path: path.readlink() if path.is_symlink() else hashlib.sha256(path.read_bytes()).hexdigest()
            for folder in folders for path in folder.rglob("*") if path.is_symlink() or path.is_file()}


def commands(root, name):
    """Every command that reads data, over one sequence and into root/out."""
    where, out, labels = ["--kitti", root / "kitti", "--sequence", name], root / 'out %d "x"', root / "labels <i>&"
    return [trials.thesis(*words) for words in (
        ["odometry", *where, "--labels", labels, "--dilation", 3, "--output", out / "p'$_$.txt", "--tum",
         out / "%s\n.tum", "--plot", out / "%d.svg", "--video", out / "%03d é.mp4"],
        ["masks", *where, "--labels", labels, "--dilation", 3, "--output", out / "masks\n&"],
        ["odometry", *where, "--masks", out / "masks\n&", "--output", out / "q<script>.txt", "--plot", out / "$_$.png"],
        ["evaluate", *where, out / "p'$_$.txt", out / "q<script>.txt", "--plot", out / "both.svg"],
        ["boresight", "--kitti", root / "kitti", "--sequences", name],
        ["check-data", "--kitti", root / "kitti", "--deep"],
        ["study", "--kitti", root / "kitti", "--labels", labels, "--masks", root / "masks", "--repetitions", 1,
         "--widths", 2, 3, "--jobs", 1, "--controls", 3, "--output", out / "study"])]


def test_names_of_every_kind_work_and_data_is_only_read(tmp_path, ledger):
    root = tmp_path / ODD
    sequence(root, SEQUENCE)
    data = root / "kitti", root / "labels <i>&", root / "masks"
    before = digests(*data)
    for command in commands(root, SEQUENCE):
        with ledger("bad inputs", f"odd names: {command[3]}"):
            trials.succeed(command, tmp_path)
            trials.lost_unless(digests(*data) == before, f"{command[3]} has changed its data")
    out = root / 'out %d "x"'
    assert {path.name for path in out.iterdir()} == {
        "p'$_$.txt", "%s\n.tum", "%d.svg", "%03d é.mp4", "masks\n&", "q<script>.txt", "$_$.png", "both.svg", "study"}
    page = (out / "study" / "index.html").read_text()
    assert "&lt;b&gt;&amp;" in page and "&lt;i&gt;&amp;" in page
    assert not any(tag in page for tag in ("<script", "<b>", "<i>"))


def make(*words):
    """What make says, without setting anything up."""
    return subprocess.run(["make", "-C", trials.ROOT, "-o", ".venv/ready", *words], capture_output=True, text=True,
                          env=trials.environment())


def test_make_takes_folders_of_any_name_and_refuses_what_it_does_not_know(tmp_path, ledger):
    odd = ODD.replace("$x$_", "").replace("\n", " ")  # make has its own idea of dollars, and none of lines
    sequence(tmp_path / odd, "00")
    with ledger("bad inputs", "make: an odd name"):
        assert make("check-data", f"KITTI={tmp_path / odd / 'kitti'}").returncode == 0
        planned = make("-n", "figures", "PROFILE=smoke", f"KITTI={tmp_path / odd}", f"BUILD={tmp_path / 'build'}")
        assert planned.returncode == 0 and f"{tmp_path / 'build'}/kitti-it-s-50-script-" in planned.stdout, planned
    for word, named in (("EPOCHS=0", "EPOCHS=0: "), ("EPOCH=3", "EPOCH: "), ("DASK_SCHEDULER=mine", "mine")):
        with ledger("bad inputs", f"make: {word}"):
            refused = make("figures", word, f"BUILD={tmp_path / 'other'}")
            trials.lost_unless(refused.returncode != 0 and not (tmp_path / "other").exists(), refused)
            assert named in refused.stderr and "Traceback" not in refused.stderr, refused


NO_CACHES = dict.fromkeys(("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR", "KERAS_HOME"))


def test_a_home_that_may_not_be_written_to_works(tmp_path, tiny_kitti, ledger):
    with ledger("faults", "no home: predict"):
        result = trials.succeed(trials.thesis("predict", "--images", "kitti/sequences/00", "--output", "out"), tmp_path,
                                HOME="/proc/nobody", **NO_CACHES)
    assert "Traceback" not in result.stderr and not any(path.startswith(".") for path in result.left)


def test_a_user_who_may_write_to_no_cache(tmp_path, tiny_kitti, ledger):
    package = tmp_path / "package" / "thesis_repro"
    shutil.copytree(trials.ROOT / "thesis_repro", package, ignore=shutil.ignore_patterns("__pycache__", "weights"))
    (tmp_path / "home").mkdir()
    for folder in (tmp_path / "home", *(path for path in [package, *package.rglob("*")] if path.is_dir())):
        folder.chmod(0o555)
    with ledger("faults", "a package and a home without permission to cache"):
        result = trials.succeed(
            trials.thesis("odometry", "--kitti", "kitti", "--sequence", "00", "--plot", "path.png"), tmp_path,
            before=without_roots_rights, PYTHONPATH=package.parent, HOME=tmp_path / "home", **NO_CACHES)
        trials.lost_unless(result.left == ["path.png"], result.left)
    for folder in [tmp_path / "home", package, *package.rglob("*")]:
        folder.chmod(folder.stat().st_mode | 0o200)


def without_roots_rights():
    """Takes from root what lets it read and write everywhere, so that permissions hold for it as for everybody."""
    if os.geteuid() == 0:
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def test_no_network_is_needed(tmp_path, ledger):
    if os.geteuid() or not shutil.which("unshare"):
        pytest.skip("only root may take the network from a process")
    sequence(tmp_path, "00")
    for command in [*commands(tmp_path, "00"),
                    trials.thesis("predict", "--images", "kitti/sequences/00", "--output", "labels2"),
                    trials.thesis("synthesize", "world", "--profile", "smoke")]:
        with ledger("faults", f"no network: {command[3]}"):
            trials.succeed(command, tmp_path, timeout=900,
                           before=lambda: ctypes.CDLL(None).unshare(CLONE_NEWNET))
