"""GpuPass: one pass over a model on a GPU: its views and boxes of voxels, and the gradients that they add."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.footprints import INEXACT
from recon.kernels.gpu.footprints import HU, beam_of, footprints, footprints_backward
from recon.kernels.gpu.images import moments, render
from recon.kernels.gpu.parameters import activate, activation_backward
from recon.kernels.gpu.rays import GpuRays
from recon.kernels.gpu.tiles import Room
from recon.kernels.gpu.voxels import fill, fill_backward, place

Parameters = tuple[Tensor, Tensor, Tensor, Tensor]  # means, scales (or their logarithms), rotations, densities


def _zeros(like: Parameters) -> Parameters:
    """Zeros of the shapes of parameters, in one array."""
    parts = torch.zeros(sum(array.numel() for array in like), device=like[0].device)
    means, scales, rotations, densities = (
        part.view(array.shape) for part, array in zip(parts.split([a.numel() for a in like]), like, strict=True)
    )
    return means, scales, rotations, densities


class GpuPass:
    """One pass over a model: physical parameters, and the gradients added by its views and boxes of voxels."""

    def __init__(
        self, means: Tensor, log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:  # fmt: skip
        self._raw, self._unit, self.kernel = (quaternions, raw), unit, kernel
        scales, rotations, densities = activate(log_scales, quaternions, raw, unit)
        self.active = (means, scales, rotations, densities)
        self.into = _zeros(self.active)

    def view(self, geometry: Geometry, view: int, faint: float, cut: float, model: RayModel) -> GpuView:
        beam = torch.from_numpy(beam_of(geometry, view)).to(self._raw[1].device)
        return GpuView(self, geometry, beam, faint, cut, model)

    def box(self, grid: Grid, faint: float, cut: float) -> GpuBox:
        return GpuBox(self, grid, faint, cut)

    def gradients(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        d_means, d_log_scales, d_rotations, d_densities = self.into
        return d_means, d_log_scales, *activation_backward(*self._raw, self._unit, d_rotations, d_densities)


class GpuView:
    """One rendered view: its image [row, col] and its backward pass."""

    def __init__(
        self, run: GpuPass, geometry: Geometry, beam: Tensor, faint: float, cut: float, model: RayModel,
        room: Room | None = None,
    ) -> None:  # fmt: skip
        """`beam` is the view as `beam_of` gives it, `room` that of its lists of tiles."""
        if geometry.width:
            raise ValueError(f"rays with a width ({geometry.width}) are projected on the CPU only: use device 'cpu'")
        self._run, self._geometry, self._beam, self._length = run, geometry, beam, model.length(geometry)
        self.footprints = footprints(
            *run.active, geometry, beam, faint, cut, self._length, model.exact_above, run.kernel
        )  # fmt: skip
        self.image = render(self.footprints, geometry.detector_shape, run.kernel, room)
        self._rays: tuple[Tensor, GpuRays] | None = None
        if geometry.is_cone and model.exact_above < math.inf:  # their number is only known after waiting for the device
            exact = torch.nonzero(self.footprints.table[:, HU.value] == INEXACT)[:, 0]
            if exact.numel() > 0:
                means, scales, rotations, densities = (array[exact] for array in run.active)
                rays = GpuRays((means, scales, rotations, densities), geometry, beam, faint, cut, run.kernel)
                rays.add_to(self.image)
                self._rays = (exact, rays)

    def backward(self, gradient: Tensor) -> Tensor:
        run, found = self._run, self.footprints
        centres = found.table.new_empty((found.table.shape[0], 2))
        footprints_backward(
            found, moments(found, gradient, run.kernel), *run.active, self._geometry, self._beam, *run.into, centres,
            self._length, run.kernel,
        )  # fmt: skip
        if self._rays is not None:
            exact, rays = self._rays
            some, moved = _zeros(rays.parameters), centres.new_empty((exact.numel(), 2))
            rays.backward(gradient, *some, moved)
            centres[exact] = moved
            for total, part in zip(run.into, some, strict=True):
                total[exact] += part  # no index is repeated, so the sum does not depend on an order
        return centres


class GpuBox:
    """One box of voxels: its density [z, y, x] and its backward pass."""

    def __init__(
        self, run: GpuPass, grid: Grid, faint: float, cut: float, corner: Tensor | None = None, room: Room | None = None
    ) -> None:
        self._run, self.placed = run, place(*run.active, grid, faint, cut, run.kernel, corner)
        self.density = fill(self.placed, room)

    def backward(self, gradient: Tensor, *, means_too: bool = True) -> None:
        fill_backward(self.placed, gradient, *self._run.active[1:], *self._run.into, means_too=means_too)
