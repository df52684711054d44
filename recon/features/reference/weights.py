"""Computes weights of total variation that are lower where a state differs from its reference, and along thin dark
lines.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage as ndi

from recon.base.arrays import F32
from recon.features.reference.motion import Moved
from recon.kernels.cpu.stencils import weighted_sum
from recon.voxels.voxel_problem import VoxelProblem

_HALF_WEIGHT_SLOPE = 0.1  # slope of the change, in particle levels per voxel, at which the weight is half
ALL_LINES, CLEAR_LINES = 2.0, 3.0
"""Standard deviations of the noise from which on a voxel of a dark line counts.

`ALL_LINES` is for a volume that ends on half voxels and is made from fewer projections than `FEW` times the columns;
`CLEAR_LINES` is for other volumes, and for the trials that choose the weight.

With 1.5 instead of 2, volumes from 30 projections of 160 columns are 0.1 to 0.9 dB worse at 10³ photons, and cracks are
equally deep. With 3, cracks keep 0.45 instead of 0.53 of their depth at 10³ photons, and 6 instead of 1 of 24 cracks
are shallower than with total variation alone. From 60 projections with 10³ photons, half voxels with 3 change the
volume by -0.3 to +0.6 dB; with 1.5 they change it by -2.6 to +0.5 dB.

With `ALL_LINES` (when it was 1.5), trials choose a weight up to 1.8 times as large, because noise that looks like a
line then has a small weight. Such volumes show cracks with 0.72 of their depth instead of 0.78 (30 projections of 160
columns, 10⁴ photons).
"""
_SEED_DEVIATIONS = 3.5  # standard deviations that the darkest voxel of a line must reach
_STEP = 0.7  # standard deviations above the first ones that lower the weight by one more unit
_LARGEST_REDUCTION = 4.0  # largest reduction by a line
# length of a line in voxels; distance in voxels from the line to its sides; number of directions
_LENGTH, _BESIDE, _TURNS = 9, 2.5, 12


def falling(problem: VoxelProblem, moved: Moved, x: F32, reference: F32, lines_from: float) -> tuple[F32, F32]:
    """Factors [y, x, z] on the weight of x, and on the weight of the change x - reference.

    Args:
        lines_from: standard deviations of the noise from which on a voxel of a dark line counts.
    """
    square = np.zeros_like(x)
    for axis in range(3):
        low = tuple(slice(None, -1) if e == axis else slice(None) for e in range(3))
        square[low] += np.square(np.diff(x - reference, axis=axis))
    slope = ndi.gaussian_filter(np.sqrt(square), 0.5) / np.float32(_HALF_WEIGHT_SLOPE * moved.particles.level)
    if not reference.any():
        return np.ones_like(x), 1 / (1 + slope)
    dark = whole_lines(dark_lines(problem, moved, x, reference), lines_from)
    lines = ndi.maximum_filter(np.maximum(dark - np.float32(lines_from), 0) / np.float32(_STEP), (3, 3, 1))
    return 1 / (1 + np.minimum(lines, 1)), 1 / (1 + slope + np.minimum(lines, np.float32(_LARGEST_REDUCTION)))


def dark_lines(problem: VoxelProblem, moved: Moved, x: F32, reference: F32) -> F32:
    """How much a line of voxels inside a particle is darker than both of its sides, in standard deviations of the
    noise.

    Lines are searched for in the change x - reference plus the filtered back-projection of the residual. The value is 0
    outside particles.
    """
    particles = moved.particles
    residual = problem.views - problem.projector.forward_lines(x)
    change, back_projected = x - reference, replace(problem, data=residual, measured=None).filtered("hann")
    if back_projected is not None:
        change = change + back_projected
    change = ndi.uniform_filter1d(change, min(3, change.shape[2]), axis=2, mode="nearest")
    solid = reference > 0.5 * particles.level + particles.base
    inner = ndi.binary_erosion(solid, np.ones((3, 3, 1)))
    best = np.zeros_like(change)
    contrast = np.empty_like(change)
    if not inner.any():
        return best
    for angle in np.arange(_TURNS) * np.pi / _TURNS:
        weighted_sum(change, line_contrast(angle), contrast)
        noise = 1.4826 * float(np.median(np.abs(contrast[inner])))
        np.maximum(best, contrast / np.float32(max(noise, 1e-30)), out=best)
    return np.where(solid, best, np.float32(0))


def whole_lines(dark: F32, lines_from: float) -> F32:
    """`dark` [y, x, z] for the voxels of lines that are surely there; 0 elsewhere.

    Voxels above `lines_from` that touch each other are one line. A line is sure if its darkest voxel reaches
    `_SEED_DEVIATIONS`; then its faint parts count, too. (Two thresholds: Canny 1986, IEEE Trans. Pattern Anal. Mach.
    Intell. 8, 679.)
    """
    is_line = ndi.binary_propagation(dark >= _SEED_DEVIATIONS, np.ones((3, 3, 3)), dark > lines_from)
    return np.where(is_line, dark, np.float32(0))


def line_contrast(angle: float) -> F32:
    """The stencil for the mean of both sides of a line minus the mean of the line, in a direction (radians from x
    towards y).
    """
    half_side = int(_LENGTH / 2 + _BESIDE) + 1
    j, i = np.mgrid[-half_side : half_side + 1, -half_side : half_side + 1]
    distance_along = i * np.cos(angle) + j * np.sin(angle)
    distance_across = np.abs(j * np.cos(angle) - i * np.sin(angle))
    share_on_line = np.clip(_LENGTH / 2 + 0.5 - np.abs(distance_along), 0, 1)
    line = share_on_line * np.clip(1 - distance_across, 0, 1)
    side = share_on_line * np.clip(1 - np.abs(distance_across - _BESIDE), 0, 1)
    return np.asarray(side / side.sum() - line / line.sum(), np.float32)
