"""Triton is loaded only if a GPU is requested, and compiles every kernel for CUDA on a machine without one.

The interpreter takes code that the compiler refuses. Triton brings its own assembler, so no driver is needed. Both
are checked in one process of their own, since here the kernels may be interpreted.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from importlib.util import find_spec
from pathlib import Path

import pytest

# What a name in a kernel's signature stands for; everything else is a float.
_INTEGERS = (
    "n pairs halvings edge tiles_y tiles_x n_tiles rows cols tile_cols shares nz ny nx bricks_y bricks_x pixels blocks "
    "voxels size0 size1 size2 size3 n_views"
)
_INDICES, _LONG = "boxes owners starts tiles go", "touched ends needed counts rooms"
_DOUBLE = "sums variation means"  # of the tally
_ARRAYS = (
    "means scales rotations densities table moments layers gradient log_scales quaternions raw d_means d_log_scales "
    "d_rotations d_densities d_centres d_quaternions d_raw image target out window source half target_maps partials "
    "weights terms sums volume beam corner weight tv_weight rates vectors "
    "rays views projections filtered p0 g0 m0 v0 p1 g1 m1 v1 p2 g2 m2 v2 p3 g3 m3 v3"
)
# Those that other kernels call.
_PARTS = {
    "along_ray", "turned", "shape_of", "add_to", "add_shape", "store_box", "_at_pixels", "_slope", "_unit_quaternion",
    "axes_of", "_softplus", "_sigmoid", "_adam_one", "scaled", "shadow", "body", "_weight", "_level", "_length",
    "_form",
}  # fmt: skip


def _load_without_triton() -> None:
    import recon.splatting.backend
    import recon.splatting.optimise

    assert "triton" not in sys.modules
    recon.splatting.backend.backend_for("cpu")
    sys.modules["triton"] = None  # type: ignore[assignment] # as if it were not installed
    with pytest.raises(ImportError, match=r"splatline\[gpu\]"):
        recon.splatting.backend.backend_for("cuda")
    del sys.modules["triton"]


def _compile_all() -> None:
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    from recon.kernels.cpu.losses import L1, L2, POISSON
    from recon.kernels.gpu import (
        back_project,
        engine,
        footprints,
        joseph,
        losses,
        parameters,
        passes,
        rays,
        tiles,
        voxels,
    )

    block, pixels = {"BLOCK": footprints._BLOCK}, {"BLOCK": losses._BLOCK}
    of_a_kernel = [
        (footprints, "_footprints", 4, block | {"CONE": False}),
        (footprints, "_footprints", 4, block | {"CONE": True}),
        (passes, "_render", 2, {"EDGE": passes._EDGE, "GROUP": passes._GROUP, "MANY": passes._MANY}),
        (passes, "_moments", 1, {"HIGH": passes._BLOCK[0], "WIDE": passes._BLOCK[1]}),
        (rays, "_terms", 4, block),
        (rays, "_render", 2, {"EDGE": rays._EDGE, "GROUP": rays._GROUP}),
        (rays, "_sums", 1, {"HIGH": rays._PIXELS[0], "WIDE": rays._PIXELS[1]}),
        (voxels, "_placed", 4, block),
        (voxels, "_fill", 4, {"EDGE": voxels._EDGE, "GROUP": voxels._GROUP}),
        (voxels, "_moments", 1, {"DEEP": voxels._DEEP, "HIGH": voxels._HIGH, "WIDE": voxels._WIDE}),
    ]
    wanted = [
        *(
            (module, name, warps, constants | {"COMPACT": compact})
            for module, name, warps, constants in of_a_kernel
            for compact in (False, True)
        ),
        (footprints, "_footprints_backward", 4, block | {"CONE": False}),
        (footprints, "_footprints_backward", 4, block | {"CONE": True}),
        (rays, "_bend", 4, block),
        (voxels, "_backward", 4, block | {"MEANS": True}),
        (losses, "_blur", 4, pixels | {"ACROSS": True}),
        (losses, "_blur", 4, pixels | {"ACROSS": False}),
        *((losses, "_products_across", 4, pixels | {"WEIGHTED": weighted}) for weighted in (False, True)),
        *((losses, "_ssim_terms", 4, pixels | {"WEIGHTED": weighted}) for weighted in (False, True)),
        (losses, "_combine", 4, pixels | {"KIND": L1, "WEIGHTED": False}),
        (losses, "_combine", 4, pixels | {"KIND": L2, "WEIGHTED": True}),
        (losses, "_combine", 4, pixels | {"KIND": POISSON, "WEIGHTED": True}),
        (losses, "_total_variation", 4, pixels),
        (parameters, "_activate", 4, block),
        *((tiles, name, 4, {"AXES": n, "BLOCK": 256}) for name in ("_touched", "_tile_of_pairs") for n in (2, 3)),
        (parameters, "_activation_backward", 4, block),
        (tiles, "_starts", 4, {"BLOCK": 256}),
        *((parameters, "_adam", 4, {"BLOCK": 4 * parameters._BLOCK, "GUARDED": guarded}) for guarded in (False, True)),
        *((parameters, "_add_lengths", 4, block | {"GUARDED": guarded}) for guarded in (False, True)),
        *(
            (joseph, "_forward", 4, {"LANES": joseph._LANES, "HIGH": high, "PLANES": joseph._PLANES, "SLICES": slices})
            for high, slices in ((1, 2), (16, 1), (32, 2))
        ),
        *(
            (joseph, "_adjoint", 4, {"EDGE": edge, "DEEP": deep, "COLS": 3, "ROWS": rows, "CONE": is_cone})
            for edge, deep, rows, is_cone in ((16, 1, 1, True), (4, 16, 1, False), (4, 64, 3, False), (4, 64, 3, True))
        ),
        *((back_project, "_back_project", 4, {"EDGE": edge, "DEEP": deep}) for edge, deep in ((16, 1), (4, 64))),
        *((engine, "_tally", 4, {"VIEWS": 2, "LISTS": 2 + boxed, "BOXED": boxed}) for boxed in (False, True)),
    ]
    modules = {module for module, *_ in wanted}
    kernels = {
        (module, name)
        for module in modules
        for name, value in vars(module).items()
        if isinstance(value, triton.JITFunction)
    }
    assert {(module, name) for module, name, *_ in wanted} == {k for k in kernels if k[1] not in _PARTS}
    forms = Counter((module, name) for module, name, *_ in wanted)
    for n, (module, name, warps, constants) in enumerate(wanted):
        kernel = getattr(module, name)
        signature, values = {}, {}
        for position, argument in enumerate(kernel.arg_names):
            if argument in constants:
                signature[argument], values[(position,)] = "constexpr", constants[argument]
            elif argument in _INTEGERS.split():
                signature[argument] = "i32"
            elif argument in _LONG.split():
                signature[argument] = "*i64"
            elif name == "_tally" and argument in _DOUBLE.split():
                signature[argument] = "*fp64"
            elif argument in _INDICES.split():
                signature[argument] = "*i32"
            else:
                signature[argument] = "*fp32" if argument in _ARRAYS.split() else "fp32"
        source = ASTSource(kernel, signature, values)
        for capability in (
            (80, 90) if forms[module, name] == 1 else (80 + 10 * (n % 2),)
        ):  # forms of a kernel take turns
            compiled = triton.compile(source, target=GPUTarget("cuda", capability, 32), options={"num_warps": warps})
            assert len(compiled.asm["cubin"]) > 0, name


@pytest.mark.slow
@pytest.mark.long
def test_triton_is_loaded_when_asked_for_and_compiles_every_kernel_for_cuda() -> None:
    if find_spec("triton") is None:
        pytest.skip("the GPU kernels need triton (extra gpu, Linux)")
    root = Path(__file__).parents[4]
    environment = {k: v for k, v in os.environ.items() if k != "TRITON_INTERPRET"} | {"PYTHONPATH": str(root)}
    subprocess.run([sys.executable, __file__], cwd=root, env=environment, check=True, timeout=200)


if __name__ == "__main__":
    _load_without_triton()
    _compile_all()
