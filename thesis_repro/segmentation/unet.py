"""The U-Net of appendix A.4, as Figure A.1 prints it."""

from typing import Any

from keras import Model, layers

from thesis_repro.errors import InputError
from thesis_repro.segmentation.exact import same_bits

DEPTH = 4  # encoder blocks; each halves the image


def build_unet(
    input_shape: tuple[int | None, int | None, int],
    n_classes: int,
    base_filters: int = 64,
    corrected_blocks: bool = False,
) -> Model:
    """Build the U-Net with a softmax over n_classes (A.4); its layer names are those of Figure A.1.

    input_shape: (height, width, channels); a height or width of None accepts any size.
    base_filters: filters of the first block, 64 in the thesis; each further encoder block has twice
    as many.
    corrected_blocks: put the two convolutions of a block in a row, as intended. In the thesis both
    read the block's input, so the output of the first one is never used and Figure A.1 lists only
    every second convolution.
    Raises InputError if height or width is not a multiple of 16.
    """
    height, width, _ = input_shape
    if (height or 0) % 2**DEPTH or (width or 0) % 2**DEPTH:
        raise InputError(
            f"image size {height}x{width}: the U-Net halves it {DEPTH} times, so height and width must be "
            f"multiples of {2**DEPTH}"
        )
    x = inputs = layers.Input(input_shape, name="input_2")
    skips = []
    for level in range(DEPTH):
        x = _conv_block(x, base_filters * 2**level, 2 * level, corrected_blocks)
        skips.append(x)
        x = layers.MaxPool2D(2, name=_numbered("max_pooling2d", level))(x)
    x = _conv_block(x, base_filters * 2**DEPTH, 2 * DEPTH, corrected_blocks)
    for step, skip in enumerate(reversed(skips)):
        filters = base_filters * 2 ** (DEPTH - 1 - step)
        x = layers.Conv2DTranspose(
            filters, 2, strides=2, padding="same", name=_numbered("conv2d_transpose", step)
        )(x)
        x = layers.Concatenate(name=_numbered("concatenate", step))([x, skip])
        x = _conv_block(x, filters, 2 * (DEPTH + 1 + step), corrected_blocks)
    outputs = layers.Conv2D(n_classes, 1, activation="softmax", name=f"conv2d_{4 * DEPTH + 2}")(x)
    return same_bits(Model(inputs, outputs, name="U-Net"))


def _conv_block(inputs: Any, filters: int, number: int, corrected: bool) -> Any:
    x = inputs
    for index in (number, number + 1):
        source = inputs  # the thesis's mistake: the second convolution reads the block's input
        if corrected:
            source = x
        x = layers.Conv2D(filters, 3, padding="same", name=_numbered("conv2d", index))(source)
        x = layers.BatchNormalization(name=_numbered("batch_normalization", index))(x)
        x = layers.Activation("relu", name=_numbered("activation", index))(x)
    return x


def _numbered(name: str, number: int) -> str:
    """Return a layer's name as Keras numbers them: the first has no number."""
    if number == 0:
        return name
    return f"{name}_{number}"
