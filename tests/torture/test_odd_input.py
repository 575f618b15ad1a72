"""Odd input that must work: names of every kind, no network, no cache; and what a run must not touch."""

import ctypes
import hashlib
import os
import shutil
import subprocess

import cv2
import numpy as np
import trials

ODD = "it's \"50%\" <script>&$x$_ é漢\n{b} #[1]*"
SEQUENCE = "<b>&\"'$_$ %s é"
CLONE_NEWNET = 0x40000000  # Linux's word for a network of one's own


def sequence(root, name, count=8):
    """A sequence of noise that moves, and its label maps in a folder with a name as odd as its own."""
    images, labels = root / "kitti" / "sequences" / name / "image_0", root / "labels <i>&"
    noise = np.random.default_rng(0).integers(0, 256, (48, 80), np.uint8)
    for folder in (images, labels, root / "kitti/poses"):
        folder.mkdir(parents=True)
    for index in range(count):
        cv2.imwrite(str(images / f"{index:06d}.png"), noise[:, index:index + 64])
        cv2.imwrite(str(labels / f"{index:06d}.png"), np.full((32, 40), [[7]] * 16 + [[23]] * 16).astype(np.uint8))
    (images.parent / "calib.txt").write_text("P0: 50 0 32 0 0 50 24 0 0 0 1 0\n")
    (root / f"kitti/poses/{name}.txt").write_text("".join(f"1 0 0 0 0 1 0 0 0 0 1 {index}\n" for index in range(count)))


def digests(*folders):
    """What is in every file below some folders."""
    return {path: hashlib.sha256(path.read_bytes()).hexdigest()
            for folder in folders for path in folder.rglob("*") if path.is_file()}


def without_network():
    """Takes the network from a process, which only root may do."""
    if os.geteuid() == 0:
        ctypes.CDLL(None).unshare(CLONE_NEWNET)


def without_roots_rights():
    """Takes from root what lets it read and write everywhere, so that permissions hold for it as for everybody."""
    if os.geteuid() == 0:
        for capability in (1, 2, 3):  # CAP_DAC_OVERRIDE, CAP_DAC_READ_SEARCH, CAP_FOWNER
            ctypes.CDLL(None).prctl(24, capability, 0, 0, 0)  # PR_CAPBSET_DROP


def test_odd_names_and_no_network_work_and_data_is_only_read(tmp_path):
    """Every command that reads or makes data."""
    root = tmp_path / ODD
    sequence(root, SEQUENCE)
    out, labels = root / 'out %d "x"', root / "labels <i>&"
    where, before = ["--kitti", root / "kitti", "--sequence", SEQUENCE], digests(root / "kitti", labels)
    for words in (
            ["odometry", *where, "--labels", labels, "--dilation", 3, "--output", out / "p'$_$.txt", "--tum",
             out / "%s\n.tum", "--plot", out / "%d.svg", "--video", out / "%03d é.mp4"],
            ["masks", *where, "--labels", labels, "--dilation", 3, "--output", out / "masks\n&"],
            ["odometry", *where, "--masks", out / "masks\n&", "--output", out / "q<script>.txt", "--plot",
             out / "$_$.png"],
            ["evaluate", *where, out / "p'$_$.txt", out / "q<script>.txt", "--plot", out / "both.svg"],
            ["boresight", "--kitti", root / "kitti", "--sequences", SEQUENCE],
            ["check-data", "--kitti", root / "kitti", "--deep"],
            ["study", "--kitti", root / "kitti", "--labels", labels, "--masks", out / "masks\n&", "--repetitions", 1,
             "--widths", 2, 3, "--jobs", 1, "--controls", 3, "--output", out / "study"],
            ["predict", "--images", root / "kitti/sequences" / SEQUENCE, "--output", out / "labels {2}"],
            ["synthesize", out / "world", "--profile", "smoke"]):
        trials.succeed(trials.thesis(*words), tmp_path, timeout=900, before=without_network)
        assert digests(root / "kitti", labels) == before, words
    assert {path.name for path in out.iterdir()} == {
        "p'$_$.txt", "%s\n.tum", "%d.svg", "%03d é.mp4", "masks\n&", "q<script>.txt", "$_$.png", "both.svg", "study",
        "labels {2}", "world"}
    page = (out / "study" / "index.html").read_text()
    assert "&lt;b&gt;&amp;" in page and "&lt;i&gt;&amp;" in page
    assert not any(tag in page for tag in ("<script", "<b>", "<i>"))


def make(*words):
    """What make says, without setting anything up."""
    return subprocess.run(["make", "-C", trials.ROOT, "-o", ".venv/ready", *words], capture_output=True, text=True,
                          env=trials.environment())


def test_make_takes_folders_of_any_name_and_refuses_what_it_does_not_know(tmp_path):
    odd = ODD.replace("$x$_", "").replace("\n", " ")  # make has its own idea of dollars, and none of lines
    sequence(tmp_path / odd, "00")
    assert make("check-data", f"KITTI={tmp_path / odd / 'kitti'}").returncode == 0
    planned = make("-n", "figures", "PROFILE=smoke", f"KITTI={tmp_path / odd}", f"BUILD={tmp_path / 'build'}")
    assert planned.returncode == 0 and f"{tmp_path / 'build'}/kitti-it-s-50-script-" in planned.stdout, planned
    for word, named in (("EPOCHS=0", "EPOCHS=0: "), ("EPOCH=3", "EPOCH: "), ("DASK_SCHEDULER=mine", "mine")):
        refused = make("figures", word, f"BUILD={tmp_path / 'other'}")
        assert refused.returncode != 0 and not (tmp_path / "other").exists(), refused
        assert named in refused.stderr and "Traceback" not in refused.stderr, refused


def test_a_user_who_may_write_to_no_cache(tmp_path, tiny_kitti):
    package, home = tmp_path / "package" / "thesis_repro", tmp_path / "home"
    shutil.copytree(trials.ROOT / "thesis_repro", package, ignore=shutil.ignore_patterns("__pycache__"))
    home.mkdir()
    folders = [home, package, *(path for path in package.rglob("*") if path.is_dir())]
    for folder in folders:
        folder.chmod(0o555)
    no_caches = dict.fromkeys(("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "MPLCONFIGDIR", "NUMBA_CACHE_DIR", "KERAS_HOME"))
    for words, output in ((["odometry", "--kitti", "kitti", "--sequence", "00", "--plot", "path.png"], "path.png"),
                          (["predict", "--images", "kitti/sequences/00", "--output", "out"], "out")):
        result = trials.succeed(trials.thesis(*words), tmp_path, before=without_roots_rights,
                                PYTHONPATH=package.parent, HOME=home, **no_caches)
        assert {path.split("/")[0] for path in result.left} == {output} and "Traceback" not in result.stderr
    for folder in folders:
        folder.chmod(0o755)
