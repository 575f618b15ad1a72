"""A small training whose bits are compared, also by another process."""

import hashlib

from thesis_repro import segmentation


def prepared():
    """Return a small U-Net, compiled, its batches, and its images."""
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
    loss = training.fused_loss(training.total_loss())
    model.compile(keras.optimizers.Adam(), loss, metrics=training.metrics())
    model.optimizer.build(model.trainable_variables)  # or TensorFlow compiles the step twice
    return model, training.Batches([(images, labels)], 3, 0), images


def digest(model, batches, images) -> str:
    """Return a digest of the weights after two epochs, and of the predictions."""
    shown = {"validation_data": batches.dataset(), "shuffle": False, "verbose": 0}
    model.fit(batches.dataset(), epochs=2, **shown)
    values = [*model.get_weights(), model.predict(images, verbose=0)]
    return hashlib.sha256(b"".join(value.tobytes() for value in values)).hexdigest()[:12]
