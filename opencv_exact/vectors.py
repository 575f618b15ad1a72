"""Vectors of one number, or one pair of numbers, for each of LANES lanes, in compiled functions.

Numba has no such types, and in loops over numbers LLVM does not find the instruction that pays
most: `dot`, which multiplies pairs and adds. There are three kinds:

- pairs of whole numbers of 16 bits, in arrays of int16 whose last axes are (LANES, 2);
- whole numbers of 32 bits, in arrays of int32 whose last axis is (LANES,);
- floats of single precision, in arrays of float32 whose last axis is (LANES,).

`+`, `-`, `*`, `&` and `>>` work lane by lane, on both numbers of a pair, with a vector of the
same kind or a whole number; a result that does not fit loses its upper bits. Processors without
AVX2 cannot run this. One with AVX-512 holds a vector in one register, one without in two.
"""

import operator
from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

LANES = 16
ROW = 24  # pixels that `read_pairs` reads
operation: Any = intrinsic  # callers leave out `typing`, which a type checker does not know


class Vector(types.Type):
    """The type of a vector of one of the three kinds."""


PAIRS, NUMBERS, FLOATS = Vector("pairs"), Vector("numbers"), Vector("floats")
_BYTE, _PAIRS = ir.IntType(8), ir.VectorType(ir.IntType(16), 2 * LANES)
_NUMBERS, _FLOATS = ir.VectorType(ir.IntType(32), LANES), ir.VectorType(ir.FloatType(), LANES)
_IN_LLVM = {PAIRS: _PAIRS, NUMBERS: _NUMBERS, FLOATS: _FLOATS}
_OF_ARRAY = {types.int16: PAIRS, types.int32: NUMBERS, types.float32: FLOATS}


@register_model(Vector)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Vector) -> None:
        super().__init__(manager, kind, _IN_LLVM[kind])


def _define(symbol: Any, instruction: str) -> None:
    """Let an operator be an instruction of LLVM."""

    @type_callable(symbol)
    def typed(context):
        def result(a, b):
            if isinstance(a, Vector) and (a == b or isinstance(b, types.Integer)):
                return a(a, a if a == b else types.intp)
            return None

        return result

    @lower_builtin(symbol, Vector, Vector)
    @lower_builtin(symbol, Vector, types.Integer)
    def code(context, builder, signature, values):
        a, b = values
        if not isinstance(signature.args[1], Vector):
            number = builder.trunc(b, a.type.element)
            one = builder.insert_element(ir.Constant(a.type, ir.Undefined), number, _index(0))
            b = _shuffle(builder, one, one, [0] * a.type.count)
        prefix = "f" if signature.return_type == FLOATS else ""
        return getattr(builder, prefix + instruction)(a, b)


for _symbol, _instruction in {
    operator.add: "add",
    operator.sub: "sub",
    operator.mul: "mul",
    operator.and_: "and_",
    operator.rshift: "ashr",
}.items():
    _define(_symbol, _instruction)


def _index(number: int) -> ir.Constant:
    return ir.Constant(ir.IntType(64), number)


def _shuffle(builder: Any, a: Any, b: Any, order: Sequence[int]) -> Any:
    """Choose elements of a and, numbered after those of a, of b."""
    mask = ir.Constant(ir.VectorType(ir.IntType(32), len(order)), list(order))
    return builder.shuffle_vector(a, b, mask)


def _place(context: Any, builder: Any, kind: Any, array: Any, index: Any) -> Any:
    """Pointer to the vector with an index, of the first axes, in an array."""
    numbers = cgutils.unpack_tuple(builder, index)
    numbers += [_index(0)] * (kind.ndim - len(numbers))
    array = context.make_array(kind)(context, builder, array)
    place = cgutils.get_item_pointer(context, builder, kind, array, numbers)
    return builder.bitcast(place, _IN_LLVM[_OF_ARRAY[kind.dtype]].as_pointer())


@operation
def load(typing, array, index):
    """The vector with an index, a tuple of the first axes, in an array that begins at 64 bytes."""

    def code(context, builder, signature, values):
        return builder.load(_place(context, builder, signature.args[0], *values), align=64)

    return _OF_ARRAY[array.dtype](array, types.UniTuple(types.intp, len(index))), code


@operation
def store(typing, array, index, vector):
    """array[index] = vector, as for `load`."""

    def code(context, builder, signature, values):
        place = _place(context, builder, signature.args[0], *values[:2])
        builder.store(values[2], place, align=64)
        return context.get_dummy_value()

    return types.void(array, types.UniTuple(types.intp, len(index)), vector), code


@operation
def dot(typing, a, b):
    """Numbers a0 * b0 + a1 * b1 of pairs (a0, a1) and (b0, b1)."""

    def code(context, builder, signature, values):
        features = context.codegen().magic_tuple()[2].split(",")
        if "+avx512bw" in features:
            return call("llvm.x86.avx512.pmaddw.d.512", builder, *values)
        (a, b), halves = values, []
        for order in range(LANES), range(LANES, 2 * LANES):
            half = _shuffle(builder, a, a, order), _shuffle(builder, b, b, order)
            halves.append(call("llvm.x86.avx2.pmadd.wd", builder, *half))
        return _shuffle(builder, halves[0], halves[1], range(LANES))

    def call(name, builder, a, b):
        kind = ir.FunctionType(ir.VectorType(ir.IntType(32), a.type.count // 2), [a.type] * 2)
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b])

    return NUMBERS(PAIRS, PAIRS), code


@operation
def join(typing, a, b):
    """Pairs (a, b) of two vectors of numbers, of each the lower 16 bits."""

    def code(context, builder, signature, values):
        low = builder.and_(values[0], ir.Constant(_NUMBERS, [0xFFFF] * LANES))
        high = builder.shl(values[1], ir.Constant(_NUMBERS, [16] * LANES))
        return builder.bitcast(builder.or_(low, high), _PAIRS)

    return PAIRS(NUMBERS, NUMBERS), code


@operation
def both(typing, pairs):
    """Numbers a0 and numbers a1 of pairs (a0, a1)."""

    def code(context, builder, signature, values):
        whole = builder.bitcast(values[0], _NUMBERS)
        half = ir.Constant(_NUMBERS, [16] * LANES)
        first = builder.ashr(builder.shl(whole, half), half)
        return context.make_tuple(
            builder, signature.return_type, [first, builder.ashr(whole, half)]
        )

    return types.UniTuple(NUMBERS, 2)(PAIRS), code


@operation
def floats(typing, numbers):
    """Numbers rounded to single precision."""

    def code(context, builder, signature, values):
        return builder.sitofp(values[0], _FLOATS)

    return FLOATS(NUMBERS), code


@operation
def zeros(typing):
    """Numbers 0."""

    def code(context, builder, signature, values):
        return ir.Constant(_NUMBERS, [0] * LANES)

    return NUMBERS(), code


@operation
def magnitudes(typing, pairs):
    """Pairs (|a0|, |a1|)."""

    def code(context, builder, signature, values):
        negative = builder.neg(values[0])
        is_positive = builder.icmp_signed(">", values[0], negative)
        return builder.select(is_positive, values[0], negative)

    return PAIRS(PAIRS), code


@operation
def read_pairs(typing, pixels, starts, offset, pairs, row):
    """pairs[row, k, lane] = pixels k and k + 1 after starts[lane] + offset, for k < ROW - 1.

    A processor reads the pixels of one lane; four neighbouring ones at a time are transposed
    in registers to those of all lanes.
    """

    def code(context, builder, signature, values):
        bytes_of = [
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:2], values[:2])
        ]
        origin = builder.gep(bytes_of[0], [values[2]])
        ways = [builder.load(builder.gep(bytes_of[1], [_index(lane)])) for lane in range(LANES)]
        # The upper half begins at 8. Each word, four pixels, makes three pairs.
        for half, words in (0, (0, 3, 6, 9)), (8, (4, 7, 10, 12)):
            lanes = [sixteen(builder, builder.gep(origin, [way]), half) for way in ways]
            for word, four in zip(words, transposed(builder, lanes, words)):
                for k in range(3):
                    pair = builder.bitcast(widened(builder, four, k), _PAIRS)
                    index = cgutils.pack_array(builder, [values[4], _index(half + word + k)])
                    place = _place(context, builder, signature.args[3], values[3], index)
                    builder.store(pair, place, align=64)
        return context.get_dummy_value()

    def sixteen(builder, way, first):
        place = builder.gep(way, [_index(first)])
        return builder.load(builder.bitcast(place, ir.VectorType(_BYTE, 16).as_pointer()), align=1)

    def widened(builder, four, k):
        """Bytes k and k + 1 of the four of each lane, each with a byte 0 after it."""
        zeros = ir.Constant(four.type, [0] * four.type.count)
        zero = four.type.count  # the first byte of these
        lanes = range(0, four.type.count, 4)
        order = [n for lane in lanes for n in (lane + k, zero, lane + k + 1, zero)]
        return _shuffle(builder, four, zeros, order)

    def transposed(builder, lanes, words):
        """Four pixels of all lanes from each word on."""
        quarters = []
        for k in range(4):  # lanes k, k + 4, k + 8, k + 12
            a, b, c, d = lanes[k::4]
            ab, cd = (_shuffle(builder, *two, range(32)) for two in ((a, b), (c, d)))
            order = [16 * lane + w + n for lane in range(4) for w in words for n in range(4)]
            four = _shuffle(builder, ab, cd, order)
            quarters.append(builder.bitcast(four, _NUMBERS))
        a, b, c, d = quarters
        low, high = (0, 4, 1, 5), (2, 6, 3, 7)
        a, b, c, d = (mixed(builder, *two, n) for two in ((a, b), (c, d)) for n in (low, high))
        low, high = (0, 1, 4, 5), (2, 3, 6, 7)
        result = (mixed(builder, *two, n) for two in ((a, c), (b, d)) for n in (low, high))
        return [builder.bitcast(four, ir.VectorType(_BYTE, 4 * LANES)) for four in result]

    def mixed(builder, a, b, order):
        """Choose four of the eight numbers in each quarter of a and b."""
        quarters = range(0, LANES, 4)
        whole = [k + (n if n < 4 else LANES + n - 4) for k in quarters for n in order]
        return _shuffle(builder, a, b, whole)

    return types.void(pixels, starts, types.intp, pairs, types.intp), code
