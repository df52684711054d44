"""picks: reads sixteen numbers from a line of an array, each lane at its own position.

Lanes pick from a window with twice as many neighbours as lanes. With AVX-512, sixteen lanes share a window, and a pick
is one instruction. With AVX2, eight lanes share a window, which begins at the pick of the first lane. On other
processors, numbers are read one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from recon.kernels.cpu.lanes import LANES, WIDTH

NEAR_STEP = 1 - 1e-5
"""The largest step from lane to lane with which eight lanes, including rounding, pick from eight neighbours."""

_F32, _I32 = ir.FloatType(), ir.IntType(32)
_VF, _VI = ir.VectorType(_F32, WIDTH), ir.VectorType(_I32, WIDTH)
_HALF = WIDTH // 2
_HF, _HI = ir.VectorType(_F32, _HALF), ir.VectorType(_I32, _HALF)
_LAST = 2 * WIDTH - 1  # as a mask of bits
_FAST = ("fast",)

Loader = Callable[[Any, Any], Any]
"""Function that emits a load of the neighbours from an offset (LLVM's i64) on, as a vector of a given type."""


def _integers(value: int, kind: Any = _VI) -> Any:
    return ir.Constant(kind, [value] * kind.count)


def _broadcast(builder: Any, number: Any, kind: Any) -> Any:
    first = builder.insert_element(ir.Constant(kind, ir.Undefined), number, ir.Constant(_I32, 0))
    return builder.shuffle_vector(first, ir.Constant(kind, ir.Undefined), _integers(0, ir.VectorType(_I32, kind.count)))


def _function(builder: Any, name: str, kind: Any, *kinds: Any) -> Any:
    return cgutils.get_or_insert_function(builder.module, ir.FunctionType(kind, kinds), name)


def _features(context: Any) -> str:
    return str(context.codegen().magic_tuple()[2])


def _lanes_per_window(context: Any) -> int:
    return _HALF if "+avx2" in _features(context) and "+avx512f" not in _features(context) else WIDTH


def _pick_sixteen(context: Any, builder: Any, numbers: Loader, at: Any, further: Any, near: bool) -> Any:
    """The numbers at + further, picked from their window. If `near`, lanes step by at most NEAR_STEP."""
    offset = ir.IntType(64)
    if _lanes_per_window(context) == _HALF:
        halves = [_pick_eight(builder, numbers, at, further, first, near) for first in (0, _HALF)]
        return builder.shuffle_vector(*halves, ir.Constant(_VI, list(range(WIDTH))))
    places = builder.add(at, _broadcast(builder, builder.trunc(further, _I32), _VI))
    if "+avx512f" in _features(context):
        pick = _function(builder, "llvm.x86.avx512.vpermi2var.ps.512", _VF, _VF, _VI, _VF)
        return builder.call(pick, [numbers(offset(0), _VF), places, numbers(offset(WIDTH), _VF)])
    places, picked = builder.and_(places, _integers(_LAST)), ir.Constant(_VF, ir.Undefined)
    for lane in range(WIDTH):
        place = builder.zext(builder.extract_element(places, ir.Constant(_I32, lane)), offset)
        number = builder.extract_element(numbers(place, ir.VectorType(_F32, 1)), ir.Constant(_I32, 0))
        picked = builder.insert_element(picked, number, ir.Constant(_I32, lane))
    return picked


def _pick_eight(builder: Any, numbers: Loader, at: Any, further: Any, first: int, near: bool) -> Any:
    """Eight lanes from `first` on by AVX2: from eight neighbours, or from one of two eights."""
    places, start = builder.shuffle_vector(at, at, ir.Constant(_HI, list(range(first, first + _HALF)))), further
    if first:
        # The window is within 32 neighbours from `further` on, also if lanes that are not needed begin elsewhere.
        begin = builder.extract_element(places, ir.Constant(_I32, 0))
        for symbol, bound in (("<", 0), (">", WIDTH)):
            begin = builder.select(builder.icmp_signed(symbol, begin, _I32(bound)), _I32(bound), begin)
        places = builder.sub(places, _broadcast(builder, begin, _HI))
        start = builder.add(start, builder.zext(begin, start.type))

    def permuted(more: int) -> Any:
        permute = _function(builder, "llvm.x86.avx2.permps", _HF, _HF, _HI)
        return builder.call(permute, [numbers(builder.add(start, start.type(more)), _HF), places])

    if near:
        return permuted(0)
    above = builder.icmp_signed("<", builder.shl(places, _integers(28, _HI)), _integers(0, _HI))
    return builder.select(above, permuted(_HALF), permuted(0))


def _line(context: Any, builder: Any, kind: Any, array: Any, row: Any, col: Any) -> Loader:
    """The numbers of a row from a column on."""
    struct = context.make_array(kind)(context, builder, array)
    strides = cgutils.unpack_tuple(builder, struct.strides, 2)
    begin = builder.add(builder.mul(row, strides[0]), builder.mul(col, col.type(4)))
    first = builder.gep(builder.bitcast(struct.data, ir.IntType(8).as_pointer()), [begin])

    def numbers(offset: Any, vector: Any) -> Any:
        address = builder.gep(builder.bitcast(first, _F32.as_pointer()), [offset])
        return builder.load(builder.bitcast(address, vector.as_pointer()), align=4)

    return numbers


@intrinsic
def lanes_per_window(typing_context):
    """Number of lanes that pick from one window: eight with AVX2, otherwise sixteen."""

    def code(context, builder, signature, args):
        return ir.IntType(64)(_lanes_per_window(context))

    return types.intp(), code


@intrinsic
def whole(typing_context, lanes):
    """The number of each lane without its fraction."""

    def code(context, builder, signature, args):
        return builder.sitofp(builder.fptosi(args[0], _VI), _VF)

    return LANES(LANES), code


@intrinsic
def least(typing_context, first, second):
    """The smaller of two Lanes, lane by lane."""

    def code(context, builder, signature, args):
        return builder.call(_function(builder, "llvm.minnum.v16f32", _VF, _VF, _VF), args, fastmath=_FAST)

    return LANES(LANES, LANES), code


def _pick(near: bool) -> Any:
    def pick(typing_context, array, row, col, at, further):
        def code(context, builder, signature, args):
            numbers = _line(context, builder, signature.args[0], *args[:3])
            return _pick_sixteen(context, builder, numbers, builder.fptosi(args[3], _VI), args[4], near)

        return LANES(array, types.intp, types.intp, LANES, types.intp), code

    return intrinsic(pick)


def _bilinear(near: bool) -> Any:
    def bilinear(typing_context, array, row, other, share, col, at):
        def code(context, builder, signature, args):
            array, row, other, share, col, at = args
            lines = [_line(context, builder, signature.args[0], array, line, col) for line in (row, other)]

            def between(lower: Any, upper: Any, part: Any) -> Any:
                step = builder.fmul(builder.fsub(upper, lower, flags=_FAST), part, flags=_FAST)
                return builder.fadd(lower, step, flags=_FAST)

            def numbers(offset: Any, vector: Any) -> Any:
                lower, upper = (line(offset, vector) for line in lines)
                return between(lower, upper, _broadcast(builder, share, vector))

            places = builder.fptosi(at, _VI)
            lower, upper = (
                _pick_sixteen(context, builder, numbers, places, col.type(further), near) for further in (0, 1)
            )
            return between(lower, upper, builder.fsub(at, builder.sitofp(places, _VF), flags=_FAST))

        return LANES(array, types.intp, types.intp, types.float32, types.intp, LANES), code

    return intrinsic(bilinear)


pick, pick_near = _pick(False), _pick(True)
"""pick(array, row, col, at, further): array[row, col + whole(at) + further], lane by lane.

For lanes that are needed, whole(at) must be 0 or more, and with `further` less than 32; with AVX2 less than 16 from the
first lane of each eight. Other lanes get any number of the window. `array` is float32, contiguous in the last axis, and
is read up to col + 32 + further. `pick_near` is for lanes that step by at most NEAR_STEP.
"""
bilinear, bilinear_near = _bilinear(False), _bilinear(True)
"""bilinear(array, row, other, share, col, at): the array at col + at, interpolated between two rows with the share of
the other row.

It picks at `at` and at one column further, as `pick` does. `bilinear_near` is for lanes that step by at most NEAR_STEP.
"""
