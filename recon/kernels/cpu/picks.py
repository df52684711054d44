"""picks: any sixteen of thirty-two neighbouring numbers, held as two Lanes, at places of their own.

With AVX-512 a pick is one instruction. Elsewhere the two Lanes are written down, and sixteen numbers read.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from recon.kernels.cpu.lanes import LANES, WIDTH

_F32, _I32 = ir.FloatType(), ir.IntType(32)
_VF, _VI = ir.VectorType(_F32, WIDTH), ir.VectorType(_I32, WIDTH)
_LAST = 2 * WIDTH - 1  # as a mask of bits
_FAST = ("fast",)


def _integers(value: int) -> Any:
    return ir.Constant(_VI, [value] * WIDTH)


def _picked(context: Any, builder: Any, pair: tuple[Any, Any], at: Any) -> Any:
    if "+avx512f" in context.codegen().magic_tuple()[2]:
        kind = ir.FunctionType(_VF, [_VF, _VI, _VF])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.x86.avx512.vpermi2var.ps.512")
        return builder.call(function, [pair[0], at, pair[1]])
    held = cgutils.alloca_once(builder, ir.ArrayType(_VF, 2))
    for k, part in enumerate(pair):
        builder.store(part, builder.gep(held, [ir.Constant(_I32, 0), ir.Constant(_I32, k)]), align=4)
    first, at = builder.bitcast(held, _F32.as_pointer()), builder.and_(at, _integers(_LAST))
    found = ir.Constant(_VF, ir.Undefined)
    for lane in range(WIDTH):
        number = builder.load(builder.gep(first, [builder.extract_element(at, ir.Constant(_I32, lane))]))
        found = builder.insert_element(found, number, ir.Constant(_I32, lane))
    return found


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
        kind = ir.FunctionType(_VF, [_VF, _VF])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.minnum.v16f32")
        return builder.call(function, args, fastmath=_FAST)

    return LANES(LANES, LANES), code


@intrinsic
def pick(typing_context, low, high, at, further):
    """The numbers whole(at) + further, modulo 32, of the sixteen of `low` and the sixteen of `high`."""

    def code(context, builder, signature, args):
        step = builder.insert_element(_integers(0), builder.trunc(args[3], _I32), ir.Constant(_I32, 0))
        step = builder.shuffle_vector(step, step, _integers(0))
        return _picked(context, builder, (args[0], args[1]), builder.add(builder.fptosi(args[2], _VI), step))

    return LANES(LANES, LANES, LANES, types.intp), code
