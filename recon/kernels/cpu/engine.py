"""The CPU kernels behind one interface: renders projections and voxel boxes of Gaussians, with backward passes.

It works on numpy arrays. `recon.kernels.gpu.engine` is the counterpart for GPUs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from recon.base.geometry import Geometry
from recon.base.kernel import Kernel, RayModel
from recon.base.volume import Grid
from recon.kernels.cpu.activation import F32, activate, activation_backward
from recon.kernels.cpu.footprints import HU, INEXACT, RayCamera, footprint_table, footprints, footprints_backward
from recon.kernels.cpu.project import moments, render, render_layers
from recon.kernels.cpu.rays import CpuRays
from recon.kernels.cpu.voxelize import Layout
from recon.kernels.cpu.wide_footprints import wide_footprints_backward, widen


@dataclass(frozen=True, eq=False)
class Active:
    """Physical parameters of Gaussians as float32 arrays, row-major rotations [n, 9], and their kernel."""

    means: F32
    scales: F32
    rotations: F32
    densities: F32
    kernel: Kernel = Kernel.GAUSSIAN

    @classmethod
    def of(
        cls, means: F32, log_scales: F32, quaternions: F32, raw: F32, unit: float, kernel: Kernel = Kernel.GAUSSIAN
    ) -> Active:
        n = raw.shape[0]
        scales, rotations = np.empty((n, 3), np.float32), np.empty((n, 9), np.float32)
        densities = np.empty(n, np.float32)
        activate(log_scales, quaternions, raw, unit, scales, rotations, densities)
        return cls(means, scales, rotations, densities, kernel)


@dataclass(frozen=True, eq=False)
class Gradients:
    """Gradients of the physical parameters; each projection or voxel box adds to them."""

    means: F32
    log_scales: F32
    rotations: F32
    densities: F32

    @classmethod
    def zeros(cls, n: int) -> Gradients:
        shapes: list[tuple[int, ...]] = [(n, 3), (n, 3), (n, 9), (n,)]
        return cls(*(np.zeros(shape, np.float32) for shape in shapes))

    def to_raw(self, quaternions: F32, raw: F32, unit: float) -> tuple[F32, F32, F32, F32]:
        """Gradients of means, log scales, quaternions and raw densities."""
        d_quaternions, d_raw = np.empty_like(quaternions), np.empty_like(raw)
        activation_backward(quaternions, raw, unit, self.rotations, self.densities, d_quaternions, d_raw)
        return self.means, self.log_scales, d_quaternions, d_raw


def camera(geometry: Geometry, view: int) -> RayCamera:
    """One projection of a geometry as a camera for the kernels."""
    axes = geometry.axes(view).astype(np.float32)
    col, row = geometry.origin(view)
    width = geometry.width.variance, geometry.width.arc / math.sqrt(12)
    if geometry.is_cone:
        return RayCamera(axes, geometry.sdd / geometry.pixel_pitch, geometry.sod, col, row, False, *width)
    straight = bool(geometry.roll[view] == 0 and geometry.tilt[view] == 0)
    return RayCamera(axes, 1 / geometry.pixel_pitch, 0.0, col, row, straight, *width)


def relative_to_centre(active: Active, geometry: Geometry, view: int) -> Active:
    """The Gaussians relative to the centre of the projection, where its axes start."""
    centre = geometry.centres[view]
    return replace(active, means=active.means - centre.astype(np.float32)) if centre.any() else active


@dataclass(frozen=True, eq=False)
class Scratch:
    """Scratch buffers for one projection of n Gaussians; projections rendered one after another may share them.

    New buffers for each projection would allocate several MB per step for 50 000 Gaussians.

    Attributes:
        table: float32 [n, 8], the footprints.
        moments: float32 [n, 6], moments of the image gradient under each footprint.
        layers: see `render_layers`.
    """

    table: F32
    moments: F32
    layers: F32

    @classmethod
    def of(cls, n: int, detector_shape: tuple[int, int]) -> Scratch:
        return cls(footprint_table(n), np.empty((n, 6), np.float32), render_layers(*detector_shape))


@dataclass(frozen=True, eq=False)
class RenderedView:
    """One rendered projection with everything that its backward pass needs.

    Attributes:
        image: line integrals [row, col].
        active: the Gaussians relative to the centre of the projection; they and `scratch` must not change before
            `backward`.
        gradient_sums: the gradients to which `backward` adds.
        camera: the projection.
        length: see `RayModel.length`.
        scratch: contains the table of footprints.
        exact: indices of the Gaussians that are integrated along each ray.
        rays: their rays; None if there are none.
    """

    image: F32
    active: Active
    gradient_sums: Gradients
    camera: RayCamera
    length: float
    scratch: Scratch
    exact: NDArray[np.intp]
    rays: CpuRays | None

    def backward(self, gradient: F32) -> F32:
        """Back-propagate an image gradient [row, col] and add the result to `gradient_sums`; returns the gradient of
        centres [n, 2] in pixels."""
        a, gradient_sums, table = self.active, self.gradient_sums, self.scratch.table
        centres = np.empty((len(gradient_sums.densities), 2), np.float32)
        gradient_moments = moments(table, gradient, self.scratch.moments, a.kernel)
        sums = gradient_sums.means, gradient_sums.log_scales, gradient_sums.rotations, gradient_sums.densities
        if self.camera.is_wide:
            parameters = a.means, a.scales, a.rotations
            wide_footprints_backward(table, gradient_moments, parameters, self.camera, sums, centres, a.kernel)
        else:
            footprints_backward(
                table, gradient_moments, a.means, a.scales, a.rotations, a.densities, self.camera, *sums, centres,
                length=self.length, kernel=a.kernel,
            )  # fmt: skip
        if self.rays is None:
            return centres
        exact_gradients, exact_centres = Gradients.zeros(self.exact.size), np.empty((self.exact.size, 2), np.float32)
        self.rays.backward(
            gradient,
            exact_gradients.means,
            exact_gradients.log_scales,
            exact_gradients.rotations,
            exact_gradients.densities,
            exact_centres,
        )
        centres[self.exact] = exact_centres
        gradient_sums.means[self.exact] += exact_gradients.means
        gradient_sums.log_scales[self.exact] += exact_gradients.log_scales
        gradient_sums.rotations[self.exact] += exact_gradients.rotations
        gradient_sums.densities[self.exact] += exact_gradients.densities
        return centres


def render_view(
    active: Active,
    gradient_sums: Gradients,
    geometry: Geometry,
    view: int,
    faint: float,
    sigmas: float,
    model: RayModel,
    scratch: Scratch,
) -> RenderedView:
    """Render the line integrals of one projection; `faint` has the same unit.

    `scratch` is overwritten. If projections share it, call `backward` of one before the next is rendered.
    """
    shape, a = geometry.detector_shape, relative_to_centre(active, geometry, view)
    image = np.empty(shape, np.float32)
    ray_camera, length = camera(geometry, view), model.length(geometry)
    footprints(
        a.means, a.scales, a.rotations, a.densities, ray_camera, faint, sigmas, scratch.table,
        length=length, exact_above=model.exact_above, kernel=a.kernel,
    )  # fmt: skip
    if ray_camera.is_wide:
        widen(scratch.table, a.means, ray_camera, faint, sigmas, a.kernel)
    render(scratch.table, image, scratch.layers, a.kernel)
    exact, rays = np.empty(0, np.intp), None
    if geometry.is_cone and model.exact_above < math.inf:
        exact = np.flatnonzero(scratch.table[:, HU] == INEXACT)
    if exact.size:
        exact_parameters = (a.means[exact], a.scales[exact], a.rotations[exact], a.densities[exact])
        rays = CpuRays(exact_parameters, ray_camera, shape, faint, sigmas, a.kernel)
        rays.add_to(image)
    return RenderedView(image, a, gradient_sums, ray_camera, length, scratch, exact, rays)


def grid_layout(active: Active, grid: Grid, faint: float, sigmas: float) -> Layout:
    """Layout of Gaussians on a grid, for filling it and its backward pass; `faint` is a density."""
    z, y, x = grid.first
    parameters = (active.means, active.scales, active.rotations, active.densities)
    return Layout(parameters, (x, y, z), grid.spacing, grid.shape, faint, sigmas, active.kernel)
