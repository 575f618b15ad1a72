"""Memory of the training input, and the speed of training input and prediction, measured on this machine.

`python -m thesis_repro.bench.segmentation` prints all of it; each function returns its numbers as a dict.
"""

import math
import tempfile
import time
from pathlib import Path

import keras
import numpy as np
import tensorflow as tf

from thesis_repro import cityscapes, files
from thesis_repro.segmentation import memory, prediction, training
from thesis_repro.segmentation.unet import build_unet

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


def input_speed(size, base_filters, batch_size, images=32, repeats=2):
    """How many times faster the input makes batches than the training of the U-Net consumes them."""
    memory.keep_freed()  # as training does
    batches = training.Batches([_noise(images, size, 0)], batch_size, seed=0)
    model = build_unet((size, size, 1), cityscapes.N_CLASSES, base_filters)
    model.compile("adam", training.total_loss(), metrics=training.metrics())
    ready = batches.dataset().cache()
    model.fit(ready, shuffle=False, verbose=0)  # compiles, and makes the batches
    consumed = min(_seconds(lambda: model.fit(ready, shuffle=False, verbose=0)) for _ in range(repeats)) / images
    made = min(_seconds(lambda: [None for _ in batches.dataset()]) for _ in range(repeats)) / images
    return {"size": size, "base_filters": base_filters, "batch_size": batch_size,
            "made_images_per_s": 1 / made, "consumed_images_per_s": 1 / consumed, "times_faster": consumed / made}


def prediction_speed(model=None, frames=48, one_by_one=12, batch_size=16, frame_size=(376, 1241)):
    """Frames per second from PNG to PNG: `model.predict` for each frame, as in A.7, and `write_label_maps`."""
    model = model or prediction.load_shipped()
    size = model.input_shape[1]
    noise = np.random.default_rng(0).integers(0, 256, (frames, *frame_size), np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder) / "frames" / f"{index:06d}.png" for index in range(frames)]
        for path, frame in zip(paths, noise, strict=True):
            files.write_png(path, frame)
        targets = Path(folder) / "labels"

        def thesis():
            for path in paths[:one_by_one]:
                image = prediction.read_input(path, model.input_shape)[None].astype(np.float32)
                label_map = model.predict(image, verbose=0).argmax(-1)[0].astype(np.uint8)
                files.write_png(targets / path.name, label_map)

        model.predict(np.zeros((1, size, size, 1), np.float32), verbose=0)  # compiles
        slow = _seconds(thesis) / one_by_one
        prediction.write_label_maps(model, paths[:batch_size], Path(folder) / "warm", batch_size)  # compiles
        fast = _seconds(lambda: prediction.write_label_maps(model, paths, Path(folder) / "maps", batch_size)) / frames
    return {"size": size, "parameters": model.count_params(), "one_by_one_frames_per_s": 1 / slow,
            "sequence_frames_per_s": 1 / fast, "times_faster": slow / fast}


def operations(model):
    """Floating-point operations of one image: a multiplication and an addition for each weight of a convolution.

    What else the network does (normalisation, activation, pooling, softmax) is some operations a value, not hundreds.
    """
    total = 0
    for layer in model.layers:
        if isinstance(layer, keras.layers.Conv2DTranspose):  # each value goes to its places through a kernel's weights
            places, weights = layer.input.shape[1:3], layer.kernel.shape
        elif isinstance(layer, keras.layers.Conv2D):
            places, weights = layer.output.shape[1:3], layer.kernel.shape
        else:
            continue
        total += 2 * math.prod(places) * math.prod(weights)
    return total


def arithmetic(model, images=prediction.CALL, side=2048, repeats=5):
    """The share of the machine's peak that a network reaches, in memory, from uint8 images to label maps.

    The peak is that of a large float32 matrix product by the same library on the same threads. Both are measured in
    turns, in processor time (all cores together, so rates are those of one core), and the median of the shares is
    taken, so that what else the machine does counts little.
    """
    size = model.input_shape[1]
    some = _noise(images, size, 0)[0]
    matrix = tf.constant(np.random.default_rng(0).standard_normal((side, side), np.float32))
    product = tf.function(lambda: tf.reduce_sum(tf.matmul(matrix, matrix)))
    product(), prediction.predict(model, some)  # compiles
    clock = time.process_time
    seconds = np.array([(_seconds(lambda: product().numpy(), clock),
                         _seconds(lambda: prediction.predict(model, some), clock)) for _ in range(repeats)])
    rates = np.array([2 * side**3, operations(model) * images]) / seconds / 1e9
    return {"size": size, "gflop_an_image": operations(model) / 1e9, "peak_gflops": float(np.median(rates[:, 0])),
            "network_gflops": float(np.median(rates[:, 1])),
            "share_of_peak": float(np.median(rates[:, 1] / rates[:, 0]))}


def _noise(count, size, seed):
    random = np.random.default_rng(seed)
    return (random.integers(0, 256, (count, size, size, 1), np.uint8),
            random.integers(0, cityscapes.N_CLASSES, (count, size, size), np.uint8))


def _resident():
    return int(Path("/proc/self/statm").read_text().split()[1]) * 4096


def _seconds(work, clock=time.perf_counter):
    started = clock()
    work()
    return clock() - started


def main():
    found = input_memory()
    print(f"input side at {found['images']} images of {found['size']}x{found['size']}: {found['gigabytes']:.2f} GB")
    for size, base_filters, batch_size in ((64, 4, 4), (160, 8, 4), (320, 16, 16)):
        found = input_speed(size, base_filters, batch_size)
        print(f"input at {size}x{size}: {found['made_images_per_s']:.0f} images/s, training with {base_filters} "
              f"filters consumes {found['consumed_images_per_s']:.1f}: {found['times_faster']:.1f} times as fast")
    model = prediction.load_shipped()
    networks = [("the model in the package", model, 48, 12)]
    for size, base_filters, frames, one_by_one in ((64, 4, 48, 12), (160, 8, 48, 12), (320, 64, 16, 4)):
        model = build_unet((size, size, 1), cityscapes.N_CLASSES, base_filters)
        networks.append((f"{base_filters} filters at {size}x{size}", model, frames, one_by_one))
    for name, model, frames, one_by_one in networks:
        found = prediction_speed(model, frames, one_by_one)
        print(f"prediction, {name}: {found['sequence_frames_per_s']:.1f} frames/s, model.predict one by one "
              f"{found['one_by_one_frames_per_s']:.1f}: {found['times_faster']:.2f} times as fast")


    for name, model, *_ in networks:
        found = arithmetic(model)
        print(f"arithmetic, {name}: {found['gflop_an_image']:.2f} GFLOP an image, {found['network_gflops']:.0f} of "
              f"{found['peak_gflops']:.0f} GFLOP/s a core: {100 * found['share_of_peak']:.0f} % of the machine's peak")


if __name__ == "__main__":
    main()
