"""No operation of the networks is computed by an approximate instruction, on any x86 processor.

TensorFlow's graph optimiser decides which operations run, and Eigen computes some of them by RCPPS
and RSQRTPS, which Intel and AMD make differently. So these tests read the optimised graphs, and a
machine of one maker tells what a machine of the other would do.
"""

import platform
from collections import Counter

import keras
import numpy as np
import pytest
import small_training
from tensorflow.python.eager import context

from thesis_repro.segmentation import prediction, training
from thesis_repro.segmentation.unet import build_unet

pytestmark = pytest.mark.slow

# equal on AMD Zen 3, on an Intel Xeon with AVX-512 and in QEMU
RECORDED = "9d39effb0706"

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


@pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="recorded on x86")
def test_a_training_has_exact_operations_only_and_the_recorded_bits():
    """One training shows both, because the U-Net takes seconds to compile."""
    prepared, digests = small_training.prepared(), []
    names = operations(lambda: digests.append(small_training.digest(*prepared)))
    assert digests == [RECORDED]
    assert names["DivNoNan"] and names["Sqrt"]  # the batch normalisation is among them
    assert names["ReluGrad"] and names["XLA Log"]  # the gradient and the loss
    assert inexact(names) == set()


def test_a_falling_rate_has_exact_operations_only():
    images, labels = np.zeros((2, 8, 8, 1), np.uint8), np.zeros((2, 8, 8), np.uint8)
    batches = training.Batches([(images, labels)], 2, 0)
    layers = [keras.Input((8, 8, 1)), keras.layers.Conv2D(35, 1, activation="softmax")]
    model = keras.Sequential(layers)
    rate = training.falling_rate(0.001, 1, batches)
    model.compile(keras.optimizers.Adam(rate), training.fused_loss(training.total_loss()))
    model.optimizer.build(model.trainable_variables)
    step = operations(lambda: model.fit(batches.dataset(), shuffle=False, verbose=0))
    assert inexact(step) == set()


def test_the_shipped_network_has_exact_operations_only():
    """Nothing in the package trains it or evaluates its loss."""
    model = prediction.load_shipped()
    images = np.random.default_rng(0).integers(0, 256, (2, *model.input_shape[1:]), np.uint8)
    for step in (
        lambda: model.predict(images.astype(np.float32), verbose=0),
        lambda: prediction.predict(model, images),
    ):
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
