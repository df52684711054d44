"""GpuVolumes: the operations of iterative voxel methods on volumes and projections, on a GPU.

The functions have the names, arguments and meaning of those in `cpu.vectors`, `cpu.spread`, `cpu.tv` and `cpu.patches`.
They work on float32 torch tensors of one device, and agree with the CPU up to rounding. All values come from
elementwise operations, slices and sums in torch's fixed order. There are no matrix products or convolutions, so TF32
cannot change anything. There are no atomics, so the same input gives bit-identical results. No tensor made here
requires gradients.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import hardshrink

from recon.base.arrays import F32
from recon.kernels.cpu.patches import EDGE
from recon.kernels.cpu.spread import passes_of
from recon.kernels.cpu.tents import cells_of, tents
from recon.kernels.cpu.tv import Weights, dual_step_size
from recon.kernels.gpu import require

Shape = tuple[int, int, int]
DualField = tuple[Tensor, Tensor, Tensor]

_AT_ONCE = 512 << 20  # bytes for temporary copies of some planes or projections at a time (at least one)
_BEYOND = EDGE - 1  # number of voxels that blocks reach beyond a face
_BLOCK_COPIES = 40  # largest number of arrays, each as large as the given planes, during the transform of their blocks
_LONG, _SHORT = math.sqrt(2) * math.cos(math.pi / 8), math.sqrt(2) * math.sin(math.pi / 8)


def combine(alpha: float, a: Tensor, beta: float, b: Tensor, out: Tensor) -> None:
    """out = alpha a + beta b; `out` may be `a` or `b`."""
    torch.add(a if alpha == 1 else a * alpha, b, alpha=beta, out=out)


def maximum(a: Tensor, b: Tensor, out: Tensor) -> None:
    """out = the elementwise maximum of a and b; `out` may be `a` or `b`."""
    torch.maximum(a, b, out=out)


def add_product(x: Tensor, factor: float, a: Tensor, b: Tensor, nonnegative: bool) -> None:
    """x += factor a b; with `nonnegative`, negative values become 0."""
    x.addcmul_(a, b, value=factor)
    if nonnegative:
        x.clamp_(min=0)


def replace_by_residual(
    data: Tensor, model: Tensor, weight: Tensor | None = None, scale: Tensor | None = None
) -> float:
    """Replace `model` by scale (data - model); returns Σ weight (data - model)², summed in float64. weight None: 1."""
    total = torch.zeros((), dtype=torch.float64, device=data.device)
    for part in _parts(data, copies=2):
        difference = torch.sub(data[part], model[part], out=model[part])
        squares = difference * difference
        if weight is not None:
            squares *= weight[part]
        if scale is not None:
            difference *= scale[part]
        total += squares.sum(dtype=torch.float64)
    return float(total)


def turn_of_steps(before: Tensor, start: Tensor, end: Tensor) -> float:
    """<start - end, end - before>, summed in float64: above zero if the step to `end` points back to `before`."""
    total = torch.zeros((), dtype=torch.float64, device=end.device)
    for part in _parts(end, copies=3):
        turn = (start[part] - end[part]).mul_(end[part] - before[part])
        total += turn.sum(dtype=torch.float64)
    return float(total)


def dot(a: Tensor, b: Tensor) -> float:
    """<a, b> of two arrays of one shape, summed in float64."""
    total = torch.zeros((), dtype=torch.float64, device=a.device)
    for part in _parts(a, copies=1):
        total += (a[part] * b[part]).sum(dtype=torch.float64)
    return float(total)


def norm(x: Tensor) -> float:
    """The root of <x, x>."""
    return math.sqrt(dot(x, x))


def tent_sums(x: Tensor, width: int) -> Tensor:
    """A volume [y, x, z] to the sums of its coarse cells [a, b, z]; see `cpu.tents`."""
    for axis in (0, 1):
        x = _summed(x, axis, width)
    return x.contiguous()


def _summed(x: Tensor, axis: int, width: int) -> Tensor:
    """Sums with tents along one axis; each step adds one voxel of each cell."""
    n = x.shape[axis]
    count, (first, share) = cells_of(n, width), tents(n, width)
    size = list(x.shape)
    size[axis] = count + 1
    out = x.new_zeros(size)
    for begin in range(width):
        voxels = range(begin, n, width)  # voxels whose cells differ, so that no sum depends on an order
        cells, weight = first[voxels.start :: width], torch.from_numpy(share[voxels.start :: width]).to(x.device)
        for shift in (0, 1):
            first_voxels = np.unique(cells + shift, return_index=True)[1]
            # outer cells may hold two of them
            for part in (first_voxels, np.setdiff1d(np.arange(len(cells)), first_voxels)):
                if part.size:
                    cells_of_part = torch.from_numpy(part).to(x.device)
                    line = [1, 1, 1]
                    line[axis] = part.size
                    factor = (weight[cells_of_part] if shift else 1 - weight[cells_of_part]).reshape(line)
                    target_cells = torch.from_numpy((cells + shift)[part]).to(x.device)
                    values = x.index_select(axis, cells_of_part * width + begin) * factor
                    out.index_copy_(axis, target_cells, out.index_select(axis, target_cells) + values)
    return out.narrow(axis, 0, count)


def add_tents(x: Tensor, factor: float, cells: Tensor, width: int) -> None:
    """x += factor times the cells [a, b, z], interpolated between their centres. Memory: one volume."""
    for axis in (1, 0):
        first, share = (torch.from_numpy(each).to(x.device) for each in tents(x.shape[axis], width))
        line = [1, 1, 1]
        line[axis] = -1
        after = (first + 1).clamp(max=cells.shape[axis] - 1)
        cells = torch.lerp(cells.index_select(axis, first), cells.index_select(axis, after), share.reshape(line))
    x.add_(cells, alpha=factor)


def filtered(cells: Tensor, transfer: F32) -> Tensor:
    """Cells [a, b, z] after a filter [a, b of rfft2] along a and b."""
    waves = torch.fft.rfft2(cells, dim=(0, 1)) * torch.from_numpy(transfer).to(cells.device)[:, :, None]
    return torch.fft.irfft2(waves, s=cells.shape[:2], dim=(0, 1))


def extrapolate(x: Tensor, factor: float, last: Tensor, start: Tensor) -> None:
    """x += factor (x - last); `last` becomes x before the update, `start` x after it."""
    torch.sub(x, last, out=start)
    torch.add(x, start, alpha=factor, out=start)
    last.copy_(x)
    x.copy_(start)


def spread(lines: Tensor, along_cols: NDArray[np.float64], along_rows: NDArray[np.float64]) -> Tensor:
    """The lines [view, col, row] blurred by passes over three neighbours, with these variances [view] in px².

    Returns `lines` itself if no pass is needed, otherwise a new tensor.
    """
    passes = passes_of(along_cols, along_rows)
    if passes == 0:
        return lines
    blurred, shares = lines.clone(), np.stack([along_cols, along_rows]) / (2 * passes)
    on_device = torch.from_numpy(shares.astype(np.float32)).to(lines.device)
    for _ in range(passes):
        for axis in (1, 2):
            if shares[axis - 1].any():
                flow = (_after(blurred, axis) - _before(blurred, axis)).mul_(on_device[axis - 1, :, None, None])
                _before(blurred, axis).add_(flow)
                _after(blurred, axis).sub_(flow)
    return blurred


def dual_step(
    x: Tensor, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: None,
    back: tuple[int, int] = (0, 0),
) -> None:  # fmt: skip
    """p <- projection onto |p| <= 1 of p + step_size D P(x - threshold Dᵀ p), in place; see `cpu.tv.dual_step`.

    Memory: two volumes in addition to x and p.
    """
    step_size = dual_step_size(threshold, weights)
    point = _primal_point(x, p, threshold, weights, nonnegative)
    for axis, (field, weight) in enumerate(zip(p, weights, strict=True)):
        _before(field, axis).add_(_after(point, axis) - _before(point, axis), alpha=step_size * weight)
    # The difference from i to i + 1 belongs to voxel i or, in a mirror image, to voxel i + 1. The last one stays 0.
    length = point.zero_()
    owners = [_after(length, axis) if mirrored else _before(length, axis) for axis, mirrored in enumerate((*back, 0))]
    for axis, (field, owner) in enumerate(zip(p, owners, strict=True)):
        owner.addcmul_(_before(field, axis), _before(field, axis))
    length.sqrt_().clamp_(min=1)
    for axis, (field, owner) in enumerate(zip(p, owners, strict=True)):
        _before(field, axis).div_(owner)


def primal(
    x: Tensor, p: DualField, threshold: float, weights: Weights, nonnegative: bool, scratch: None, out: Tensor
) -> None:
    """out = P(x - threshold Dᵀ p); `out` may be `x`."""
    out.copy_(_primal_point(x, p, threshold, weights, nonnegative))


def _primal_point(x: Tensor, p: DualField, threshold: float, weights: Weights, nonnegative: bool) -> Tensor:
    pull = torch.zeros_like(x)
    for axis, (field, weight) in enumerate(zip(p, weights, strict=True)):
        _before(pull, axis).sub_(_before(field, axis), alpha=weight)
        _after(pull, axis).add_(_before(field, axis), alpha=weight)
    torch.add(x, pull, alpha=-threshold, out=pull)
    return pull.clamp_(min=0) if nonnegative else pull


def denoise(x: Tensor, threshold: float, nonnegative: bool, scratch: None, out: Tensor) -> None:
    """out = D(x) of `cpu.patches`, at least 0 with `nonnegative`; `out` may be `x`.

    Several planes of blocks are transformed at a time; the result does not depend on their number, bit for bit. Memory:
    one volume in addition to x and `out`, plus half a GiB or forty planes, whichever is more.

    Args:
        x: [a, b, c].
        threshold: threshold for coefficients, in the unit of x; white noise with standard deviation σ has coefficients
            with standard deviation σ.
    """
    na, nb, nc = x.shape
    axes = (0, 1, 2) if nc >= EDGE else (0, 1)
    voxels_at = [_mirrored(x.shape[axis], x.device) for axis in axes]
    sums = x.new_zeros((na + 2 * _BEYOND, nb, nc))
    limit = threshold * 2 ** len(axes)
    plane = math.prod(n + 2 * _BEYOND for n in (nb, nc))
    step = max(1, _AT_ONCE // (4 * _BLOCK_COPIES * plane))
    for first in range(0, na + _BEYOND, step):
        end = min(first + step, na + _BEYOND)  # end of the blocks' first planes
        extended = x.index_select(0, voxels_at[0][first : end + _BEYOND])
        for axis in axes[1:]:
            extended = extended.index_select(axis, voxels_at[axis])
        # A voxel sums its blocks in the order of their first planes, so the result does not depend on the first plane
        # of a part.
        for offset, value in reversed(list(enumerate(_shrunk(extended, axes, limit, True)))):
            sums[first + offset : end + offset] += value
    torch.mul(sums[_BEYOND : na + _BEYOND], 16.0 ** -len(axes), out=out)
    if nonnegative:
        out.clamp_(min=0)


def _shrunk(extended: Tensor, axes: Sequence[int], limit: float, mean: bool) -> list[Tensor]:
    """The contributions of each block to voxels 0 to 3 along the first of `axes`, summed over blocks along the others.

    Args:
        limit: coefficients up to this become 0.
        mean: True: the first coefficient is kept.
    """
    axis, *others = axes
    coefficients = []
    for order, cosines in enumerate(_cosines(extended, axis)):
        is_mean = mean and order == 0
        if others:
            n = extended.shape[others[0]] - 2 * _BEYOND
            parts = _shrunk(cosines, others, limit, is_mean)
            a, b, c, d = (part.narrow(others[0], _BEYOND - offset, n) for offset, part in enumerate(parts))
            coefficients.append((d + c).add_(b).add_(a))
        else:
            coefficients.append(cosines if is_mean else hardshrink(cosines, limit))
    return _inverse_cosines(*coefficients)


def _cosines(extended: Tensor, axis: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Twice the four orthonormal cosine coefficients, along one axis, of each block of `extended`."""
    blocks = extended.shape[axis] - _BEYOND
    a, b, c, d = (extended.narrow(axis, offset, blocks) for offset in range(EDGE))
    outer, inner, wide, near = a + d, b + c, a - d, b - c
    return outer + inner, wide * _LONG + near * _SHORT, outer - inner, wide * _SHORT - near * _LONG


def _inverse_cosines(a: Tensor, b: Tensor, c: Tensor, d: Tensor) -> list[Tensor]:
    """Twice the inverse of the orthonormal transform."""
    outer, inner, wide, near = a + c, a - c, b * _LONG + d * _SHORT, b * _SHORT - d * _LONG
    return [outer + wide, inner + near, inner - near, outer - wide]


def _mirrored(n: int, device: torch.device) -> Tensor:
    """The voxel (of n) at each position from -3 to n + 2, mirrored at both faces."""
    position = torch.arange(-_BEYOND, n + _BEYOND, device=device) % (2 * n)
    return torch.minimum(position, 2 * n - 1 - position)


def pulled_step(
    x: Tensor, change: Tensor, momentum: float, step_size: float, gradient: Tensor, pull: float, z: Tensor,
    nonnegative: bool,
) -> None:  # fmt: skip
    """change = momentum change + step_size (gradient + pull (z - x)), x += change; with `nonnegative`, x is at least 0.

    Memory: one volume.
    """
    step = torch.sub(z, x)
    torch.add(gradient, step, alpha=pull, out=step)
    change.mul_(momentum).add_(step, alpha=step_size)
    torch.add(x, change, out=step)
    if nonnegative:
        step.clamp_(min=0)
    torch.sub(step, x, out=change)
    x.copy_(step)


def _before(array: Tensor, axis: int) -> Tensor:
    """All elements except the last along an axis."""
    return array.narrow(axis, 0, array.shape[axis] - 1)


def _after(array: Tensor, axis: int) -> Tensor:
    """All elements except the first along an axis."""
    return array.narrow(axis, 1, array.shape[axis] - 1)


def _parts(array: Tensor, copies: int) -> list[slice]:
    """Slices of the first axis, each as long as `copies` copies fit into the memory budget."""
    step = max(1, _AT_ONCE // (4 * copies * max(1, math.prod(array.shape[1:]))))
    return [slice(first, first + step) for first in range(0, array.shape[0], step)]


class GpuVolumes:
    """Volumes and projections on one device, and the operations on them."""

    combine, replace_by_residual = staticmethod(combine), staticmethod(replace_by_residual)
    maximum, add_product = staticmethod(maximum), staticmethod(add_product)
    turn_of_steps, spread = staticmethod(turn_of_steps), staticmethod(spread)
    dot, norm = staticmethod(dot), staticmethod(norm)
    tent_sums, add_tents, filtered = staticmethod(tent_sums), staticmethod(add_tents), staticmethod(filtered)
    extrapolate, pulled_step = staticmethod(extrapolate), staticmethod(pulled_step)
    dual_step, primal, denoise = staticmethod(dual_step), staticmethod(primal), staticmethod(denoise)

    def __init__(self, device: str | torch.device) -> None:
        """Raises as `require`."""
        self.device = require(device)

    def array(self, values: F32) -> Tensor:
        """A copy on the device."""
        return torch.from_numpy(np.array(values, np.float32, order="C")).to(self.device)

    def numpy(self, array: Tensor) -> F32:
        """A copy on the host."""
        return array.to("cpu", copy=True, memory_format=torch.contiguous_format).numpy()

    def copy(self, array: Tensor) -> Tensor:
        return array.clone()

    def zeros(self, shape: tuple[int, ...]) -> Tensor:
        return torch.zeros(shape, dtype=torch.float32, device=self.device)

    def dual_field(self, shape: Shape) -> DualField:
        """Zeros [a, b, c] for the differences along each axis; element i is the difference from i to i + 1."""
        return self.zeros(shape), self.zeros(shape), self.zeros(shape)

    def dual_scratch(self, shape: Shape) -> None:
        """Scratch memory for `dual_step` and `primal`; only the CPU needs it."""

    def patch_scratch(self, shape: Shape) -> None:
        """Scratch memory for `denoise`; only the CPU needs it."""
