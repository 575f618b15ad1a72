"""Batch normalisation by exact division, for the networks that ask for it.

TensorFlow computes 1 / v and 1 / sqrt(v) with the instructions RCPPS and RSQRTPS. These are
approximations, and Intel and AMD approximate differently. Keras' layer for batch normalisation asks
for 1 / sqrt(variance). Division and square root are exact to the last bit on every processor
(IEEE 754).
"""

from functools import partial
from typing import Any

import keras

# Keras' own defaults: a user's keras.json may hold others
keras.config.set_floatx("float32")
keras.config.set_epsilon(1e-7)
keras.config.set_image_data_format("channels_last")


def same_bits(model: Any) -> Any:
    """Let the batch normalisation of one model divide exactly; return the model.

    Only this object changes: its weights, its configuration and its file stay Keras' own, and a
    copy that Keras loads from the file normalises as Keras does. Call it before the model is
    compiled or run. Layers with other settings than Keras' defaults (another axis or precision,
    synchronised or renormalised) and those of a model within the model stay as they are, and all
    of them with another backend of Keras.
    """
    if keras.backend.backend() != "tensorflow":
        return model
    for layer in model.layers:
        if type(layer) is keras.layers.BatchNormalization and _has_usual_settings(layer):
            layer.call = partial(_normalize, layer)
    return model


def _has_usual_settings(layer: keras.layers.BatchNormalization) -> bool:
    return (
        layer.axis == -1
        and layer.compute_dtype == "float32"
        and layer.scale
        and layer.center
        and not layer.renorm
        and not layer.synchronized
    )


def _normalize(
    layer: keras.layers.BatchNormalization,
    inputs: Any,
    training: bool | None = None,
    mask: Any = None,
) -> Any:
    """Return gamma * (inputs - mean) / sqrt(variance + epsilon) + beta.

    In training, mean and variance are those of the batch, and the layer's moving averages follow
    them; otherwise they are the moving averages. mask: Keras gives one, but images have none.
    """
    import tensorflow as tf  # another backend of Keras may be without it

    mean, variance = layer.moving_mean, layer.moving_variance
    if training and layer.trainable:
        mean, variance = keras.ops.moments(inputs, axes=list(range(len(inputs.shape) - 1)))
        for average, new in ((layer.moving_mean, mean), (layer.moving_variance, variance)):
            average.assign(average * layer.momentum + new * (1 - layer.momentum))
    # TensorFlow rewrites 1 / sqrt(v), sqrt(1 / v) and a / sqrt(v) to the approximations. It leaves
    # divide_no_nan as it is.
    deviation = tf.sqrt(variance + layer.epsilon)
    factor = tf.math.divide_no_nan(tf.convert_to_tensor(layer.gamma), deviation)
    return inputs * factor + (layer.beta - mean * factor)
