"""The device of the tests of Triton kernels: CUDA if there is a GPU, otherwise the interpreter; geometries,
comparisons."""

from __future__ import annotations

import importlib
import os
from typing import Any

import pytest
import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.splatting.autograd import Project, Renderer, Voxelize
from recon.splatting.gaussians import Gaussians
from tests.recon.helpers import as_leaves, gradients
from tests.recon.kernels import reference

if not torch.cuda.is_available():
    # it is read when triton and the kernels are first imported, which happens here
    os.environ["TRITON_INTERPRET"] = "1"
pytest.importorskip("triton", reason="the GPU kernels need triton (extra gpu, Linux)")


def _prepare_the_language_once() -> None:
    """Let Triton's interpreter replace the functions of its language only once.

    It replaces them when a kernel is launched, and again at each call of a function within it, which takes a quarter of
    the time of these tests.
    """
    interpreter, language = (importlib.import_module(f"triton.{name}") for name in ("runtime.interpreter", "language"))
    prepare, modules = interpreter._patch_lang, (language, language.core)

    def once(function: Any) -> Any:
        seen = [value for value in function.__globals__.values() if any(value is m for m in modules)]
        fresh = any(language.core.is_builtin(module.load) for module in seen)
        return prepare(function) if fresh else interpreter._LangPatchScope()

    if hasattr(interpreter, "_LangPatchScope"):
        interpreter._patch_lang = once  # type: ignore[attr-defined]


_prepare_the_language_once()
DEVICE: torch.device = importlib.import_module("recon.kernels.gpu").require("cuda")
WHOLE = (1e-12, 9.0)  # faint, cut: practically no cut-off
AFFINE, EXACT = RayModel(), RayModel(exact_above=0.0)
UNIT = 0.7
SHAPE = (19, 26)  # not a multiple of a tile


def parallel(shape: tuple[int, int] = SHAPE) -> Geometry:
    return Geometry.parallel([0.7, -4.0], shape, pixel_pitch=0.5, axis_col=shape[1] / 2 - 1.7)


def leaned() -> Geometry:
    return Geometry.parallel([2.5], SHAPE, pixel_pitch=0.5, axis_row=8.2, shifts=[[1.3, -0.8]], roll=0.2, tilt=0.3)


def cone(shape: tuple[int, int] = SHAPE) -> Geometry:
    return Geometry.cone(
        [0.4], shape, 1.1, 22.0, 45.0, axis_col=shape[1] / 2 - 1.1, shifts=[[-0.6, 0.4]], roll=-0.1, tilt=0.2
    )


def project_raw(*arguments: Any) -> Tensor:
    """The projections of raw parameters and their unit, which `recon.project` calls on a GPU."""
    *raw, unit, geometry, faint, cut, model = arguments
    return Project.apply(*raw, Renderer(unit, Kernel.GAUSSIAN, _gpu()), geometry, (faint, cut, model))


def voxelize_raw(*arguments: Any) -> Tensor:
    *raw, unit, grid, faint, cut = arguments
    return Voxelize.apply(*raw, Renderer(unit, Kernel.GAUSSIAN, _gpu()), grid, (faint, cut))


def _gpu() -> Any:
    return importlib.import_module("recon.kernels.gpu.engine").Gpu("cuda")


def raw_of(g: Gaussians, device: torch.device) -> tuple[Tensor, ...]:
    leaves = as_leaves(g)
    tensors = (leaves.means, leaves.log_scales, leaves.quaternions, leaves.raw_densities)
    return tuple(t.detach().to(device).requires_grad_() for t in tensors)


def reference_view(g: Gaussians, geometry: Geometry, view: int) -> Tensor:
    return reference.project_view((g.means, g.scales, g.quaternions, g.densities), geometry, view)


def assert_gradients(found: tuple[Tensor, ...], double: Gaussians, relative: float = 2e-5) -> None:
    for tensor, (name, expected) in zip(found, gradients(double).items(), strict=True):
        assert tensor.grad is not None
        off = float((tensor.grad.cpu().double() - expected).abs().max())
        assert off < relative * float(expected.abs().max()), name
