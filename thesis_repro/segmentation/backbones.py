"""Networks beyond the thesis's (Section 5.2): published backbones, and ensembles. Both predict like any model."""

import os

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
os.environ.setdefault("SM_FRAMEWORK", "tf.keras")

import keras
import segmentation_models as sm

from thesis_repro import InputError


def backbone_unet(name):
    """A function of (input_shape, n_classes) that builds a U-Net around a backbone of segmentation-models.

    Weights are random: the published ones would need a
    download and colour. Grey levels 0 to 255 are scaled to 0 to 1, as these networks were made for.

    Raises InputError for an unknown name, and where height or width is not a multiple of 32.
    """
    if name not in sm.get_available_backbone_names():
        raise InputError(f"backbone {name!r}: unknown; choose one of {', '.join(sm.get_available_backbone_names())}")

    def build(input_shape, n_classes):
        if input_shape[0] % 32 or input_shape[1] % 32:
            raise InputError(f"image size {input_shape[0]}x{input_shape[1]}: backbones halve it five times, so height "
                             "and width must be multiples of 32")
        network = sm.Unet(name, input_shape=input_shape, classes=n_classes, activation="softmax", encoder_weights=None)
        inputs = keras.Input(input_shape)
        return keras.Model(inputs, network(keras.layers.Rescaling(1 / 255)(inputs)), name=f"unet_{name}")

    return build


def ensemble(models):
    """One model whose probabilities are the mean of those of several models of one input and output shape.

    Raises InputError for no models and for models of different shapes.
    """
    shapes = {(model.input_shape, model.output_shape) for model in models}
    if len(shapes) != 1:
        raise InputError(f"ensemble: {len(models)} models with {len(shapes)} different shapes; it needs one or more "
                         "models of the same input and output shape")
    inputs = keras.Input(models[0].input_shape[1:])
    outputs = []
    for number, model in enumerate(models):
        # a copy, for the same model twice or two of one name must not collide; without the loss, which has no copy
        member = keras.models.clone_model(keras.Model(model.input, model.output))
        member.set_weights(model.get_weights())
        member.name = f"member_{number}"
        outputs.append(member(inputs))
    mean = keras.layers.Average()(outputs) if len(outputs) > 1 else outputs[0]
    return keras.Model(inputs, mean, name="ensemble")
