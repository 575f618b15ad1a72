"""Batch normalisation with the same bits on every processor; an import puts it in place.

TensorFlow's `tf.nn.batch_normalization`, which Keras' layer calls, takes 1 / sqrt(variance) with
the instruction RSQRTPS. That is an approximation, and Intel and AMD approximate differently.
Division and square root are exact to the last bit on every processor (IEEE 754).
"""

import tensorflow as tf


def batch_normalization(
    x: tf.Tensor,
    mean: tf.Tensor,
    variance: tf.Tensor,
    offset: tf.Tensor | None,
    scale: tf.Tensor | None,
    variance_epsilon: float,
    name: str | None = None,
) -> tf.Tensor:
    """Return scale * (x - mean) / sqrt(variance + variance_epsilon) + offset.

    The arguments are those of `tf.nn.batch_normalization`; offset and scale may be None.
    """
    # TensorFlow turns 1 / sqrt(v), but not sqrt(1 / v), into the approximation
    factor = tf.sqrt(1 / (variance + variance_epsilon))
    factor = factor if scale is None else factor * scale
    shift = -mean * factor if offset is None else offset - mean * factor
    return x * factor + shift


tf.nn.batch_normalization = batch_normalization
