"""No operation of the networks is computed by an approximate instruction, on any x86 processor.

TensorFlow's graph optimiser decides which operations run, and Eigen computes some of them by RCPPS
and RSQRTPS, which Intel and AMD make differently. So these tests read the optimised graphs, and a
machine of one maker tells what a machine of the other would do.
"""

from collections import Counter

import keras
import numpy as np
import pytest
from tensorflow.python.eager import context

from thesis_repro.segmentation import prediction, training
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow

# Operations that move values, handle variables, or compute with whole numbers; and those on data
# sets, whose names say so
MOVING = set(
    [
        "_Arg",
        "_DeviceArg",
        "_Retval",
        "_EagerConst",
        "_Send",
        "_Recv",
        "ArgMax",
        "AssignVariableOp",
        "BroadcastTo",
        "Cast",
        "ConcatOffset",
        "ConcatV2",
        "Const",
        "GatherV2",
        "Greater",
        "Identity",
        "MakeIterator",
        "NoOp",
        "OneHot",
        "Pack",
        "PartitionedCall",
        "Prod",
        "PyFunc",
        "RandomShuffle",
        "Range",
        "ReadVariableOp",
        "Reshape",
        "Shape",
        "ShapeN",
        "Slice",
        "Squeeze",
        "StridedSlice",
        "VarHandleOp",
        "VarIsInitializedOp",
    ]
)
ON_DATA = ("Dataset", "Iterator", "Optional")
# Operations that add, multiply, compare, divide by a / b or take square roots, in Eigen or oneDNN.
# IEEE 754 fixes each of these to the bit. The library of TensorFlow 2.21 holds RCPPS and RSQRTPS in
# 139 functions (objdump -d libtensorflow_cc.so.2). They belong to Reciprocal, Inv and Rsqrt, to
# Softmax, FusedBatchNorm and LRN without oneDNN, to Atan, Atan2, Erfc, Ndtri, Bessel functions and
# logarithms of complex numbers, and to optimisers in C++, but to none of these names. A new name
# goes here only if that is true of it.
EXACT = set(
    [
        "Add",
        "AddN",
        "AddV2",
        "AssignAddVariableOp",
        "AssignSubVariableOp",
        "BiasAdd",
        "BiasAddGrad",
        "DivNoNan",
        "Mean",
        "Minimum",
        "Mul",
        "Neg",
        "Pow",
        "RealDiv",
        "Relu",
        "ReluGrad",
        "Sqrt",
        "SqrtGrad",
        "Square",
        "SquaredDifference",
        "Sub",
        "Sum",
        "_MklNativeConv2D",
        "_MklNativeConv2DBackpropFilter",
        "_MklNativeConv2DBackpropFilterWithBias",
        "_MklNativeConv2DBackpropInput",
        "_MklNativeFusedConv2D",
        "_MklNativeMaxPool",
        "_MklNativeMaxPoolGrad",
        "_MklSoftmax",
    ]
)


# XLA compiles the loss. It divides exactly (a test below shows it), and its logarithm is a
# polynomial. Its Rsqrt is approximate.
EXACT_IN_XLA = set(
    [
        "BroadcastGradientArgs",
        "DynamicStitch",
        "Fill",
        "FloorMod",
        "GreaterEqual",
        "LessEqual",
        "Log",
        "Maximum",
        "Reciprocal",
        "SelectV2",
        "Tile",
        "ZerosLike",
    ]
)


def operations(step):
    """Count the operations of all graphs that TensorFlow runs during a call, after its optimiser.

    The names of those that XLA compiles begin with "XLA ".
    """
    context.context().enable_run_metadata()
    try:
        step()
        metadata = context.context().export_run_metadata()
    finally:
        context.context().disable_run_metadata()
    names = Counter()
    for function in metadata.function_graphs:
        for graph in function.partition_graphs:  # the last form of a graph, with oneDNN's kernels
            names.update(name for node in graph.node for name in parts(node))
            for called in graph.library.function:
                compiler = "XLA " if called.attr["_XlaMustCompile"].b else ""
                names.update(compiler + name for node in called.node_def for name in parts(node))
    return names


def parts(node):
    """Return the name of an operation, and the names of those that the optimiser fused into it."""
    if node.op == "_UnaryOpsComposition":
        return [name.decode() for name in node.attr["op_names"].list.s]
    fused = [name.decode() for name in node.attr["fused_ops"].list.s]
    return [node.op, *fused]


def inexact(names):
    """Return the names that are not known to be exact."""
    known = MOVING | EXACT | {f"XLA {name}" for name in MOVING | EXACT | EXACT_IN_XLA}
    return {name for name in names.keys() - known if not any(word in name for word in ON_DATA)}


def steps(model):
    """Yield a training step, a validation step and predictions of a model."""
    size = model.input_shape[1]
    random = np.random.default_rng(0)
    images = random.integers(0, 256, (2, *model.input_shape[1:]), np.uint8)
    labels = random.integers(0, 35, (2, size // 8, size // 8), np.uint8).repeat(8, 1).repeat(8, 2)
    batches = training.Batches([(images, labels)], 2, 0)
    loss = training.fused_loss(training.total_loss())
    rate = training.falling_rate(0.001, 1, batches)
    model.compile(keras.optimizers.Adam(rate), loss, metrics=training.metrics())
    model.optimizer.build(model.trainable_variables)  # or TensorFlow compiles the step twice
    yield lambda: model.fit(batches.dataset(), shuffle=False, verbose=0)
    yield lambda: model.evaluate(batches.dataset(), verbose=0)
    yield lambda: model.predict(images.astype(np.float32), verbose=0)
    yield lambda: prediction.predict(model, images)


@pytest.mark.parametrize(
    "network, first",
    # nothing in the package trains the shipped model or evaluates its loss
    [(lambda: build_unet((128, 128, 1), 35, 8), 0), (prediction.load_shipped, 2)],
)
def test_the_networks_use_exact_operations_only(network, first):
    for step in [*steps(network())][first:]:
        names = operations(step)
        assert names["DivNoNan"] and names["Sqrt"]  # the batch normalisation is among them
        assert inexact(names) == set()


def test_other_models_keep_keras_own_batch_normalisation():
    ours = build_unet((32, 32, 1), 35, 2)
    copy = keras.models.clone_model(ours)
    assert copy.to_json() == ours.to_json()
    image = np.random.default_rng(0).integers(0, 256, (1, 32, 32, 1)).astype(np.float32)
    assert inexact(operations(lambda: ours.predict(image, verbose=0))) == set()
    assert inexact(operations(lambda: copy.predict(image, verbose=0))) == {"Rsqrt"}
