"""Compare the bits of a training on this processor with those on an emulated one.

usage: python tools/emulated.py        needs qemu-x86_64 (Debian and Ubuntu: package qemu-user)

Intel and AMD differ in two instructions, RCPPS and RSQRTPS, which approximate 1 / v and
1 / sqrt(v). QEMU computes both exactly. So equal digests mean that no approximation reaches a
result, and a processor of another maker gives the same bits as this one. The command also counts
which of these instructions the emulated training has executed at all. It takes about ten minutes on
a quiet core. The exit status is 0 if the digests are equal and no such instruction was executed.
"""

import hashlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path

from thesis_repro import segmentation
from thesis_repro.errors import InputError
from thesis_repro.running import console

EMULATOR = "qemu-x86_64"
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


def emulated_digest(emulator: str) -> tuple[str, Counter]:
    """Return the digest of an emulated process, and {(instruction, function): number of places}
    for the approximate instructions that it has come to.

    QEMU logs each piece of code once, when the process comes to it for the first time.
    """
    code = "import emulated; print(emulated.digest())"
    seen: Counter = Counter()
    with tempfile.TemporaryDirectory() as folder:
        log = Path(folder) / "log"
        os.mkfifo(log)  # the log has gigabytes, so it is read while it is written
        reader = threading.Thread(target=_count, args=(log, seen))
        reader.start()
        output = subprocess.run(
            [emulator, "-cpu", "max", "-d", "in_asm", "-D", log, sys.executable, "-c", code],
            cwd=Path(__file__).parent,
            stdout=subprocess.PIPE,
            text=True,
            check=True,
        ).stdout
        reader.join()
    return output.split()[-1], seen


def _count(log: Path, seen: Counter) -> None:
    function = ""
    with open(log, errors="replace") as lines:
        for line in lines:
            if line.startswith("IN:"):
                function = line[3:].strip()
            elif found := APPROXIMATE.search(line):
                seen[found[0], function] += 1
                print(line, function, file=sys.stderr)


def main() -> None:
    emulator = shutil.which(EMULATOR)
    if emulator is None:
        raise InputError(f"{EMULATOR}: not found; install it (Debian and Ubuntu: qemu-user)")
    native = digest()
    print(f"{native}   on this processor", flush=True)
    emulated, seen = emulated_digest(emulator)
    print(f"{emulated}   emulated, where RCPPS and RSQRTPS are exact")
    executed = ", ".join(f"{name} ({count} places)" for name, count in seen.items())
    print(f"approximate instructions in the emulated code: {executed or 'none'}")
    if native != emulated or seen:
        raise InputError("the training depends on the processor's maker; see test_exact.py")


if __name__ == "__main__":
    console.run_main(main)
