"""Lanes: sixteen float32 numbers as one numba value, with a vectorised exp (numba's own exp is scalar).

`Lanes` is LLVM's <16 x float>, which LLVM compiles to AVX-512, AVX2, SSE or NEON instructions, depending on the
machine. `+ - * /` work between Lanes and with scalars, which are broadcast. No compiler is needed at run time.
"""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.core.types.misc import unliteral
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import intrinsic, lower_builtin, models, register_model

WIDTH = 16

_F32, _I32 = ir.FloatType(), ir.IntType(32)
_VF, _VI = ir.VectorType(_F32, WIDTH), ir.VectorType(_I32, WIDTH)
_FAST = ("fast",)

# 2^f on [-1/2, 1/2]: polynomial with the smallest relative error (Remez exchange), 2e-9, below the rounding of float32.
_EXP2 = (1.53458120e-4, 1.33999312e-3, 9.61848896e-3, 5.55032878e-2, 2.40226469e-1, 6.93147206e-1, 1.0)


class LanesType(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes16f32")


LANES = LanesType()


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, _VF)


def _constant(value: float, kind: Any = _VF) -> Any:
    return ir.Constant(kind, [value] * WIDTH)


def _broadcast(builder: Any, scalar: Any, kind: Any = _VF) -> Any:
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), scalar, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), ir.Constant(_VI, [0] * WIDTH))


def _as_lanes(builder: Any, kind: Any, value: Any) -> Any:
    if isinstance(kind, LanesType):
        return value
    if isinstance(kind, types.Integer):
        return _broadcast(builder, builder.sitofp(value, _F32))
    return _broadcast(builder, value if kind == types.float32 else builder.fptrunc(value, _F32))


def _vector_function(builder: Any, name: str, arity: int) -> Any:
    kind = ir.FunctionType(_VF, [_VF] * arity)
    return cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v16f32")


def _register(symbol: Callable[..., Any], instruction: str) -> None:
    """Types and lowers an operator by hand; with `overload` the compiler would copy a function to each addition."""

    @infer_global(symbol)
    class Operation(AbstractTemplate):
        def generic(self, args: Any, kws: Any) -> Any:
            kinds = [unliteral(kind) for kind in args]
            if LANES in kinds and all(isinstance(kind, LanesType | types.Number) for kind in kinds):
                return LANES(*kinds)
            return None

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        left, right = (_as_lanes(builder, k, a) for k, a in zip(signature.args, args, strict=True))
        return getattr(builder, instruction)(left, right, flags=_FAST)

    for kinds in ((LanesType, LanesType), (LanesType, types.Number), (types.Number, LanesType)):
        lower_builtin(symbol, *kinds)(code)


_OPERATORS = ((operator.add, "fadd"), (operator.sub, "fsub"), (operator.mul, "fmul"), (operator.truediv, "fdiv"))
for _symbol, _instruction in _OPERATORS:
    _register(_symbol, _instruction)


@intrinsic
def iota(typing_context):
    """Lanes 0, 1, ..., 15."""

    def code(context, builder, signature, args):
        return ir.Constant(_VF, [float(i) for i in range(WIDTH)])

    return LANES(), code


@intrinsic
def zero(typing_context):
    """All lanes 0."""

    def code(context, builder, signature, args):
        return _constant(0.0)

    return LANES(), code


def _address(context: Any, builder: Any, array_type: Any, array: Any, row: Any, col: Any) -> Any:
    struct = context.make_array(array_type)(context, builder, array)
    strides = cgutils.unpack_tuple(builder, struct.strides, 2)
    offset = builder.add(builder.mul(row, strides[0]), builder.mul(col, ir.Constant(col.type, 4)))
    raw = builder.gep(builder.bitcast(struct.data, ir.IntType(8).as_pointer()), [offset])
    return builder.bitcast(raw, _VF.as_pointer())


@intrinsic
def load(typing_context, array, row, col):
    """Sixteen neighbours array[row, col:col + 16] of a float32 array [row, col], contiguous in the last axis."""

    def code(context, builder, signature, args):
        return builder.load(_address(context, builder, signature.args[0], *args), align=4)

    return LANES(array, types.intp, types.intp), code


@intrinsic
def store(typing_context, array, row, col, lanes):
    """array[row, col:col + 16] = lanes."""

    def code(context, builder, signature, args):
        builder.store(args[3], _address(context, builder, signature.args[0], *args[:3]), align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, LANES), code


def _transposed(builder: Any, rows: list[Any]) -> list[Any]:
    """Sixteen vectors, transposed: rows and lanes are exchanged, one bit of their numbers at a time."""
    for bit in (1, 2, 4, 8):
        low = [lane if not lane & bit else WIDTH + lane - bit for lane in range(WIDTH)]
        high = [lane + bit if not lane & bit else WIDTH + lane for lane in range(WIDTH)]
        picks = (ir.Constant(_VI, high), ir.Constant(_VI, low))
        rows = [builder.shuffle_vector(rows[i & ~bit], rows[i | bit], picks[not i & bit]) for i in range(WIDTH)]
    return rows


def _addresses(context: Any, builder: Any, signature: Any, args: Any) -> tuple[list[Any], list[Any]]:
    """Addresses of array[row + i, col + shifts[i]] and of other[other_row + i, 0]."""
    types_of_args, addresses, other_addresses = signature.args, [], []
    for i in range(WIDTH):
        number = ir.Constant(args[1].type, i)
        shifts = context.make_array(types_of_args[3])(context, builder, args[3])
        col = builder.add(args[2], builder.load(builder.gep(shifts.data, [number])))
        addresses.append(_address(context, builder, types_of_args[0], args[0], builder.add(args[1], number), col))
        row, start = builder.add(args[5], number), ir.Constant(args[1].type, 0)
        other_addresses.append(_address(context, builder, types_of_args[4], args[4], row, start))
    return addresses, other_addresses


@intrinsic
def load_transposed(typing_context, array, row, col, shifts, out, out_row):
    """out[out_row + k, i] = array[row + i, col + shifts[i] + k], i and k below sixteen; `shifts` of type intp."""

    def code(context, builder, signature, args):
        addresses, out_addresses = _addresses(context, builder, signature, args)
        vectors = _transposed(builder, [builder.load(source_address, align=4) for source_address in addresses])
        for vector, address in zip(vectors, out_addresses, strict=True):
            builder.store(vector, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, shifts, out, types.intp), code


@intrinsic
def add_transposed(typing_context, array, row, col, shifts, source, source_row):
    """array[row + i, col + shifts[i] + k] += source[source_row + k, i]: the transpose of `load_transposed`."""

    def code(context, builder, signature, args):
        addresses, source_addresses = _addresses(context, builder, signature, args)
        vectors = _transposed(builder, [builder.load(source_address, align=4) for source_address in source_addresses])
        for vector, address in zip(vectors, addresses, strict=True):
            builder.store(builder.fadd(builder.load(address, align=4), vector, flags=_FAST), address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, shifts, source, types.intp), code


@intrinsic
def between(typing_context, lanes, low, high):
    """The lanes low, ..., high - 1; zero in the others."""

    def code(context, builder, signature, args):
        numbers = ir.Constant(_VI, list(range(WIDTH)))
        low, high = (_broadcast(builder, builder.trunc(bound, _I32), _VI) for bound in args[1:])
        inside = builder.and_(builder.icmp_signed(">=", numbers, low), builder.icmp_signed("<", numbers, high))
        return builder.select(inside, args[0], _constant(0.0))

    return LANES(LANES, types.intp, types.intp), code


@intrinsic
def sign(typing_context, lanes):
    """-1, 0 or 1 for each lane."""

    def code(context, builder, signature, args):
        below = builder.select(builder.fcmp_ordered("<", args[0], _constant(0.0)), _constant(-1.0), _constant(0.0))
        return builder.select(builder.fcmp_ordered(">", args[0], _constant(0.0)), _constant(1.0), below)

    return LANES(LANES), code


@intrinsic
def root(typing_context, lanes):
    """The square root of each lane."""

    def code(context, builder, signature, args):
        return builder.call(_vector_function(builder, "sqrt", 1), args, fastmath=_FAST)

    return LANES(LANES), code


@intrinsic
def quarter_turn(typing_context, lanes):
    """i times eight complex numbers: (a, b) becomes (-b, a) in each pair of lanes."""

    def code(context, builder, signature, args):
        swapped = ir.Constant(_VI, [lane ^ 1 for lane in range(WIDTH)])
        signs = ir.Constant(_VF, [-1.0, 1.0] * (WIDTH // 2))
        return builder.fmul(builder.shuffle_vector(args[0], _constant(0.0), swapped), signs)

    return LANES(LANES), code


@intrinsic
def positive(typing_context, lanes):
    """max(x, 0) for each lane."""

    def code(context, builder, signature, args):
        return builder.call(_vector_function(builder, "maxnum", 2), [args[0], _constant(0.0)], fastmath=_FAST)

    return LANES(LANES), code


@intrinsic
def clamp(typing_context, lanes, low, high):
    """min(max(x, low), high) for each lane, with float32 bounds."""

    def code(context, builder, signature, args):
        value, low, high = args[0], _broadcast(builder, args[1]), _broadcast(builder, args[2])
        value = builder.call(_vector_function(builder, "maxnum", 2), [value, low], fastmath=_FAST)
        return builder.call(_vector_function(builder, "minnum", 2), [value, high], fastmath=_FAST)

    return LANES(LANES, types.float32, types.float32), code


@intrinsic
def larger(typing_context, lanes, size):
    """The lanes whose absolute value exceeds `size`, a float32; zero in the others."""

    def code(context, builder, signature, args):
        size = builder.call(_vector_function(builder, "fabs", 1), args[:1])
        return builder.select(builder.fcmp_ordered(">", size, _broadcast(builder, args[1])), args[0], _constant(0.0))

    return LANES(LANES, types.float32), code


@intrinsic
def lowest(typing_context, lanes):
    """Lane 0."""

    def code(context, builder, signature, args):
        return builder.extract_element(args[0], ir.Constant(_I32, 0))

    return types.float32(LANES), code


@intrinsic
def total(typing_context, lanes):
    """The sum of the lanes."""

    def code(context, builder, signature, args):
        kind = ir.FunctionType(_F32, [_F32, _VF])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.vector.reduce.fadd.v16f32")
        return builder.call(function, [ir.Constant(_F32, 0.0), args[0]], fastmath=_FAST)

    return types.float32(LANES), code


def _halve(builder: Any, x: tuple[Any, list[int]], y: tuple[Any, list[int]], width: int) -> tuple[Any, list[int]]:
    """Add the two halves of each group of 2 width lanes: x's sums go to the lower half, y's to the upper one.

    Each vector has a list that names, for each lane, the vector whose sum it contains; the list gives the final
    positions.
    """
    low, high, owners = [], [], []
    for base in range(0, WIDTH, 2 * width):
        for source in (0, 1):
            low += [source * WIDTH + base + i for i in range(width)]
            high += [source * WIDTH + base + width + i for i in range(width)]
            owners += (x, y)[source][1][base : base + width]
    parts = (builder.shuffle_vector(x[0], y[0], ir.Constant(_VI, picks)) for picks in (low, high))
    return builder.fadd(*parts, flags=_FAST), owners


@intrinsic
def totals(typing_context, vectors):
    """Sums of up to sixteen Lanes at once, lane j for vectors[j], with about half the shuffles of single sums."""
    count = len(vectors)

    def code(context, builder, signature, args):
        level = [(builder.extract_value(args[0], j), [j] * WIDTH) for j in range(count)]
        for width in (8, 4, 2, 1):
            pairs = [(level[j], level[min(j + 1, len(level) - 1)]) for j in range(0, len(level), 2)]
            level = [_halve(builder, x, y, width) for x, y in pairs]
        ((summed, owners),) = level
        order = [owners.index(min(j, count - 1)) for j in range(WIDTH)]
        return builder.shuffle_vector(summed, summed, ir.Constant(_VI, order))

    return LANES(vectors), code


def _first(builder: Any, count: Any) -> Any:
    """A mask of the lanes below `count`."""
    count = _broadcast(builder, builder.trunc(count, _I32), _VI)
    return builder.icmp_signed("<", ir.Constant(_VI, list(range(WIDTH))), count)


@intrinsic
def load_first(typing_context, array, row, col, count):
    """array[row, col:col + count], followed by zeros; memory beyond is not read."""

    def code(context, builder, signature, args):
        mask, pointer = _first(builder, args[3]), _VF.as_pointer()
        kind = ir.FunctionType(_VF, [pointer, _I32, mask.type, _VF])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.load.v16f32.p0")
        address = _address(context, builder, signature.args[0], *args[:3])
        return builder.call(function, [address, ir.Constant(_I32, 4), mask, _constant(0.0)])

    return LANES(array, types.intp, types.intp, types.intp), code


@intrinsic
def store_first(typing_context, array, row, col, lanes, count):
    """array[row, col:col + count] = the first lanes."""

    def code(context, builder, signature, args):
        mask, pointer = _first(builder, args[4]), _VF.as_pointer()
        kind = ir.FunctionType(ir.VoidType(), [_VF, pointer, _I32, mask.type])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.masked.store.v16f32.p0")
        address = _address(context, builder, signature.args[0], *args[:3])
        builder.call(function, [args[3], address, ir.Constant(_I32, 4), mask])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, LANES, types.intp), code


@intrinsic
def exp(typing_context, lanes):
    """e^x for each lane, to 2e-7 + 1.2e-7 |x| (relative); exponents are clamped to +-87, so that it is finite.

    x = (k + f) ln 2 with k whole and |f| <= 1/2. 2^f comes from a polynomial, 2^k from writing k into the exponent
    bits.
    """

    def code(context, builder, signature, args):
        def multiply(x, y):
            return builder.fmul(x, y, flags=_FAST)

        def add(x, y):
            return builder.fadd(x, y, flags=_FAST)

        t = multiply(args[0], _constant(1.4426950408889634))
        t = builder.call(_vector_function(builder, "maxnum", 2), [t, _constant(-126.0)], fastmath=_FAST)
        t = builder.call(_vector_function(builder, "minnum", 2), [t, _constant(126.0)], fastmath=_FAST)
        whole = builder.call(_vector_function(builder, "rint", 1), [t])
        fraction = builder.fsub(t, whole, flags=_FAST)
        power = _constant(_EXP2[0])
        for coefficient in _EXP2[1:]:
            power = add(multiply(power, fraction), _constant(coefficient))
        bits = builder.shl(builder.add(builder.fptosi(whole, _VI), _constant(127, _VI)), _constant(23, _VI))
        return multiply(power, builder.bitcast(bits, _VF))

    return LANES(LANES), code
