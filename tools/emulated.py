"""Compare the bits of a training on this processor with those on an emulated one.

usage: python tools/emulated.py        needs qemu-x86_64 (Debian and Ubuntu: package qemu-user)

Intel and AMD differ in two instructions, RCPPS and RSQRTPS, which approximate 1 / v and
1 / sqrt(v). QEMU computes both exactly. So equal digests mean that no approximation reaches the
result of this training. It takes about ten minutes on a quiet core. The exit status is 0 if the
digests are equal.
"""

import hashlib
import shutil
import subprocess
import sys
from pathlib import Path

from thesis_repro import segmentation
from thesis_repro.errors import InputError
from thesis_repro.running import program


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
    model.optimizer.build(model.trainable_variables)  # or TensorFlow compiles the step twice
    batches = training.Batches([(images, labels)], 3, 0)
    model.fit(batches.dataset(), epochs=2, shuffle=False, verbose=0)
    values = [*model.get_weights(), model.predict(images, verbose=0)]
    return hashlib.sha256(b"".join(value.tobytes() for value in values)).hexdigest()[:12]


def main() -> None:
    """Print both digests, and raise InputError if they differ."""
    emulator = shutil.which("qemu-x86_64")
    if emulator is None:
        raise InputError("qemu-x86_64: not found; install it (Debian and Ubuntu: qemu-user)")
    native = digest()
    print(f"{native}   on this processor", flush=True)
    command = [
        emulator,
        "-cpu",
        "max",
        sys.executable,
        "-c",
        "import emulated; print(emulated.digest())",
    ]
    folder = Path(__file__).parent
    output = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True).stdout
    print(f"{output.strip()}   emulated, where RCPPS and RSQRTPS are exact")
    if native not in output.split():
        raise InputError("the training depends on the processor's maker; see test_exact.py")


if __name__ == "__main__":
    program.run_main(main)
