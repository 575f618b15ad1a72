"""The U-Net of appendix A.4, as Figure A.1 prints it."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")

from keras import Model, layers

from thesis_repro import InputError

DEPTH = 4  # encoder blocks; each halves the image


def build_unet(input_shape, n_classes, base_filters=64, corrected_blocks=False):
    """The U-Net for images of input_shape (height, width, channels), with a softmax over n_classes (A.4).

    A height or width of None leaves the size open: the network is convolutions from end to end.

    `base_filters` is the width of the first block: 64 in the thesis, doubled by each of the four encoder blocks.

    In the thesis both convolutions of a block read the block's input, so the first one leads nowhere and Figure A.1
    counts every second convolution only. `corrected_blocks` puts the two in a row, as they were meant.

    Layer names are those of Figure A.1. Raises InputError where height or width is not a multiple of 16.
    """
    height, width, _ = input_shape
    if (height or 0) % 2**DEPTH or (width or 0) % 2**DEPTH:
        raise InputError(f"image size {height}x{width}: the U-Net halves it {DEPTH} times, so height and width must be "
                         f"multiples of {2**DEPTH}")
    inputs = layers.Input(input_shape, name="input_2")
    x, skips = inputs, []
    for level in range(DEPTH):
        x = _conv_block(x, base_filters * 2**level, 2 * level, corrected_blocks)
        skips.append(x)
        x = layers.MaxPool2D(2, name=_numbered("max_pooling2d", level))(x)
    x = _conv_block(x, base_filters * 2**DEPTH, 2 * DEPTH, corrected_blocks)
    for step, skip in enumerate(reversed(skips)):
        filters = base_filters * 2 ** (DEPTH - 1 - step)
        x = layers.Conv2DTranspose(filters, 2, strides=2, padding="same",
                                   name=_numbered("conv2d_transpose", step))(x)
        x = layers.Concatenate(name=_numbered("concatenate", step))([x, skip])
        x = _conv_block(x, filters, 2 * (DEPTH + 1 + step), corrected_blocks)
    outputs = layers.Conv2D(n_classes, 1, activation="softmax", name=f"conv2d_{4 * DEPTH + 2}")(x)
    return Model(inputs, outputs, name="U-Net")


def _conv_block(inputs, filters, number, corrected):
    x = inputs
    for index in (number, number + 1):
        source = x if corrected else inputs  # the thesis's slip: the second convolution starts at the input again
        x = layers.Conv2D(filters, 3, padding="same", name=_numbered("conv2d", index))(source)
        x = layers.BatchNormalization(name=_numbered("batch_normalization", index))(x)
        x = layers.Activation("relu", name=_numbered("activation", index))(x)
    return x


def _numbered(name, number):
    return f"{name}_{number}" if number else name


def summary_rows(model):
    """The rows of Figure A.1 for a model: dicts of layer, output_shape, params and connected_to.

    Class and shape are written the way Figure A.1 has them, so the two can be compared word by word.
    """
    rows = []
    for layer in model.layers:
        kind = type(layer).__name__
        shape = f"{tuple(layer.output.shape)}"
        sources = [] if kind == "InputLayer" else layer._inbound_nodes[0].input_tensors
        rows.append({
            "layer": f"{layer.name} ({kind.replace('BatchNormalization', 'BatchNormal')})",
            "output_shape": f"[{shape}]" if kind == "InputLayer" else shape,
            "params": layer.count_params(),
            "connected_to": " ".join(f"{tensor._keras_history.operation.name}[0][0]" for tensor in sources),
        })
    return rows
