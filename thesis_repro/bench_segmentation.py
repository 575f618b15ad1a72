"""Memory of the training input, and the speed of training input and prediction, measured on this machine.

`python -m thesis_repro.bench_segmentation` prints all of it; each function returns its numbers as a dict.
"""

import tempfile
import time
from pathlib import Path

import numpy as np

from thesis_repro import cityscapes, files, segmentation, training
from thesis_repro.unet import build_unet

TRAINING_IMAGES, VALIDATION_IMAGES = 2380, 595  # Section 3.5.2, before augmentation doubles them
GB = 1e9


def input_memory(size=320, batch_size=16, batches=12):
    """Gigabytes that the input side holds at the thesis's 4760 + 1190 images while it makes batches."""
    before, peak = _resident(), 0
    sets = [[_noise(count, size, seed) for seed in range(2)] for count in (TRAINING_IMAGES, VALIDATION_IMAGES)]
    for some in sets:
        for number, _ in enumerate(training.Batches(some, batch_size, seed=0).dataset()):
            peak = max(peak, _resident())
            if number == batches:
                break
    return {"images": 2 * (TRAINING_IMAGES + VALIDATION_IMAGES), "size": size, "gigabytes": (peak - before) / GB}


def input_speed(size, base_filters, batch_size, images=64, repeats=3):
    """How many times faster the input makes batches than a training step of the U-Net consumes them."""
    batches = training.Batches([_noise(images, size, 0)], batch_size, seed=0)
    model = build_unet((size, size, 1), cityscapes.N_CLASSES, base_filters)
    training.compile_model(model)
    x, y = next(iter(batches.dataset()))
    model.train_on_batch(x, y)  # compiles
    consumed = min(_seconds(lambda: model.train_on_batch(x, y)) for _ in range(repeats)) / batch_size
    made = min(_seconds(lambda: [None for _ in batches.dataset()]) for _ in range(repeats)) / images
    return {"size": size, "base_filters": base_filters, "batch_size": batch_size,
            "made_images_per_s": 1 / made, "consumed_images_per_s": 1 / consumed, "times_faster": consumed / made}


def prediction_speed(model=None, frames=48, one_by_one=12, batch_size=16, frame_size=(376, 1241)):
    """Frames per second from PNG to PNG: `model.predict` for each frame, as in A.7, and `write_label_maps`."""
    model = model or segmentation.load_shipped()
    size = model.input_shape[1]
    noise = np.random.default_rng(0).integers(0, 256, (frames, *frame_size), np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "frames" / f"{index:06d}.png" for index in range(frames)]
        for path, frame in zip(paths, noise, strict=True):
            files.write_png(path, frame)
        targets = Path(folder) / "labels"

        def thesis():
            for path in paths[:one_by_one]:
                image = segmentation.read_input(path, model.input_shape)[None].astype(np.float32)
                label_map = model.predict(image, verbose=0).argmax(-1)[0].astype(np.uint8)
                files.write_png(targets / path.name, label_map)

        model.predict(np.zeros((1, size, size, 1), np.float32), verbose=0)  # compiles
        slow = _seconds(thesis) / one_by_one
        segmentation.write_label_maps(model, paths[:batch_size], Path(folder) / "warm", batch_size)  # compiles
        fast = _seconds(lambda: segmentation.write_label_maps(model, paths, Path(folder) / "maps", batch_size)) / frames
    return {"size": size, "parameters": model.count_params(), "one_by_one_frames_per_s": 1 / slow,
            "sequence_frames_per_s": 1 / fast, "times_faster": slow / fast}


def _noise(count, size, seed):
    random = np.random.default_rng(seed)
    return (random.integers(0, 256, (count, size, size, 1), np.uint8),
            random.integers(0, cityscapes.N_CLASSES, (count, size, size), np.uint8))


def _resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def _seconds(work):
    started = time.perf_counter()
    work()
    return time.perf_counter() - started


def main():
    print("input at 4760 + 1190 images:", _round(input_memory()))
    for size, base_filters, batch_size in ((64, 4, 4), (160, 16, 8), (320, 16, 16)):
        print("input against training:", _round(input_speed(size, base_filters, batch_size)))
    print("prediction, shipped model:", _round(prediction_speed()))
    for size, base_filters in ((64, 4), (160, 16), (320, 64)):
        model = build_unet((size, size, 1), cityscapes.N_CLASSES, base_filters)
        print("prediction:", _round(prediction_speed(model, one_by_one=6)))


def _round(numbers):
    return {name: round(value, 3) if isinstance(value, float) else value for name, value in numbers.items()}


if __name__ == "__main__":
    main()
