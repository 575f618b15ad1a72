"""Compare the bits of a training on this processor with those on an emulated one.

usage: python tools/emulated.py        needs qemu-x86_64 (Debian and Ubuntu: package qemu-user)

Intel and AMD differ in two instructions, RCPPS and RSQRTPS, which approximate 1 / v and
1 / sqrt(v). QEMU computes both exactly. So equal digests mean that no approximation reaches the
result of this training. The command also lists which of these instructions the emulated training
came to, and in which files. It takes about ten minutes on a quiet core. The exit status is 0 if the
digests are equal and no such instruction lies in TensorFlow or in code that it made.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

from thesis_repro import segmentation
from thesis_repro.errors import InputError
from thesis_repro.running import messages

EMULATOR = "qemu-x86_64"
DIGEST = re.compile("[0-9a-f]{12}")
# a package that Albumentations loads; the training does not call it
HARMLESS = "simsimd"
APPROXIMATE = re.compile(r"\bv?r(?:cp|sqrt)(?:14|28)?[ps][sd]\b")  # in QEMU's log of instructions


def digest() -> str:
    """Return a digest of the weights after two epochs of a small U-Net, and of its predictions."""
    with segmentation.quietly():
        import keras
        import numpy as np

        from thesis_repro.segmentation import training
        from thesis_repro.segmentation.unet import build_unet
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (6, 96, 96, 1), np.uint8)
    labels = random.integers(0, 35, (6, 12, 12), np.uint8).repeat(8, 1).repeat(8, 2)
    keras.utils.set_random_seed(0)
    model = build_unet((96, 96, 1), 35, 4)
    model.compile(keras.optimizers.Adam(), training.fused_loss(training.total_loss()))
    batches = training.Batches([(images, labels)], 3, 0)
    model.fit(batches.dataset(), epochs=2, shuffle=False, verbose=0)
    values = [*model.get_weights(), model.predict(images, verbose=0)]
    return hashlib.sha256(b"".join(value.tobytes() for value in values)).hexdigest()[:12]


def emulated_digest(emulator: str) -> tuple[str, list[str]]:
    """Return the digest of an emulated process, and where it came to approximate instructions.

    QEMU logs each piece of code when the process comes to it for the first time.
    """
    code = "import emulated; print(emulated.digest()); print(open('/proc/self/maps').read())"
    places: list[tuple[str, int]] = []
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        os.mkfifo(log)  # the log has gigabytes, so it is read while it is written
        # a daemon, because it waits forever if QEMU does not start
        reader = threading.Thread(target=_read, args=(log, places), daemon=True)
        reader.start()
        output = subprocess.run(
            [emulator, "-cpu", "max", "-d", "in_asm", "-D", log, sys.executable, "-c", code],
            cwd=Path(__file__).parent,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout
        reader.join()
    lines = output.splitlines()
    start = next(number for number, line in enumerate(lines) if DIGEST.fullmatch(line))
    maps = [line for line in lines[start + 1 :] if line]
    return lines[start], [f"{name} in {_place(address, maps)}" for name, address in places]


def _read(log: Path, places: list[tuple[str, int]]) -> None:
    """Collect the approximate instructions of QEMU's log, and their addresses."""
    with open(log, errors="replace") as lines:
        for line in lines:
            instruction = APPROXIMATE.search(line)
            if instruction:
                places.append((instruction[0], int(line.partition(":")[0], 16)))


def _place(address: int, maps: list[str]) -> str:
    """Return the file and the offset in it of an address, from the lines of /proc/self/maps."""
    for line in maps:
        span, _, offset, _, _, *path = line.split(maxsplit=5)
        first, end = (int(bound, 16) for bound in span.split("-"))
        if first <= address < end and path:
            return f"{Path(path[0]).name} at {address - first + int(offset, 16):#x}"
    return "code that was made while running"


def main() -> None:
    """Print both digests and the places, and raise InputError if the digests differ."""
    emulator = shutil.which(EMULATOR)
    if emulator is None:
        raise InputError(f"{EMULATOR}: not found; install it (Debian and Ubuntu: qemu-user)")
    native = digest()
    print(f"{native}   on this processor", flush=True)
    emulated, places = emulated_digest(emulator)
    print(f"{emulated}   emulated, where RCPPS and RSQRTPS are exact")
    print(
        f"approximate instructions that the emulated training came to: {len(places)}",
        *places,
        sep="\n  ",
    )
    if native != emulated or not all(HARMLESS in place for place in places):
        raise InputError("the training depends on the processor's maker; see test_exact.py")


if __name__ == "__main__":
    messages.run_main(main)
