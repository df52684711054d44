"""Fused losses on a GPU: data term, D-SSIM and total variation, with their gradients (Triton)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.kernels.cpu.losses import ABSOLUTE, L1, L2, RADIUS, DataTerm, gaussian_window

_BLOCK = 256
_R = tl.constexpr(RADIUS)
_L1, _L2 = tl.constexpr(L1), tl.constexpr(L2)
_LARGEST = tl.constexpr(1.0e38)
_C = 0.01**2, 0.03**2  # constants of SSIM for images with values of about 1


@triton.jit
def _blur(source, out, window, rows, cols, pixels, ACROSS: tl.constexpr, BLOCK: tl.constexpr):
    """Blur each map [k, row, col] along one axis of the window, with zeros outside; grid axis 2: the map."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < pixels
    first = tl.program_id(1).to(tl.int64) * pixels
    row, col = i // cols, i % cols
    total = tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(-_R, _R + 1):
        weight = tl.load(window + (tap + _R))
        if ACROSS:
            at, ok = i + tap, live & (col + tap >= 0) & (col + tap < cols)
        else:
            at, ok = i + tap * cols, live & (row + tap >= 0) & (row + tap < rows)
        total += weight * tl.load(source + first + at, ok, 0.0)
    tl.store(out + first + i, total, live)


@triton.jit
def _products_across(image, target, weights, out, window, cols, pixels, WEIGHTED: tl.constexpr, BLOCK: tl.constexpr):
    """x, x² and xy blurred along the rows, out [3, row, col]; pixels of weight 0 count as 0."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < pixels
    col = i % cols
    bx, bxx, bxy = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(-_R, _R + 1):
        ok = live & (col + tap >= 0) & (col + tap < cols)
        y = tl.load(target + i + tap, ok, 0.0)
        if WEIGHTED:
            ok = ok & (tl.load(weights + i + tap, ok, 0.0) > 0.0)
        x = tl.load(image + i + tap, ok, 0.0)
        weighted = tl.load(window + (tap + _R)) * x
        bx, bxx, bxy = bx + weighted, bxx + weighted * x, bxy + weighted * y
    tl.store(out + i, bx, live)
    tl.store(out + pixels + i, bxx, live)
    tl.store(out + 2 * pixels + i, bxy, live)


@triton.jit
def _ssim_terms(
    half, target_maps, weights, partials, sums, window, rows, cols, pixels, c1, c2, WEIGHTED: tl.constexpr,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """Finish the blur down the columns; sum w (1 - SSIM) of a block, and derivatives of w SSIM by blurred x, x², xy."""
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    live = i < pixels
    row = i // cols
    mx, mxx, mxy = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(-_R, _R + 1):
        ok = live & (row + tap >= 0) & (row + tap < rows)
        weight, at = tl.load(window + (tap + _R)), half + i + tap * cols
        mx += weight * tl.load(at, ok, 0.0)
        mxx += weight * tl.load(at + pixels, ok, 0.0)
        mxy += weight * tl.load(at + 2 * pixels, ok, 0.0)
    my, myy = tl.load(target_maps + i, live, 0.0), tl.load(target_maps + pixels + i, live, 0.0)
    # Clamp differences of squares, because rounding must not make them negative or break Cauchy-Schwarz.
    vx = tl.minimum(tl.maximum(mxx - mx * mx, 0.0), _LARGEST)
    vy, vxy = tl.minimum(tl.maximum(myy - my * my, 0.0), _LARGEST), mxy - mx * my
    low1, low2 = 1.0 / (mx * mx + my * my + c1), 1.0 / (vx + vy + c2)
    structure = 2.0 * tl.minimum(tl.maximum(vxy * low2, -0.5), 0.5) + c2 * low2
    luminance, heavy, weight = (2.0 * mx * my + c1) * low1, low2, 1.0
    if WEIGHTED:
        weight = tl.load(weights + i, live, 0.0)
        structure, heavy = structure * weight, low2 * weight
    value = luminance * structure
    d_vx, d_vxy = -value * low2, 2.0 * luminance * heavy
    d_mx = 2.0 * low1 * (my * structure - mx * value)
    tl.store(partials + i, d_mx - 2.0 * mx * d_vx - my * d_vxy, live)
    tl.store(partials + pixels + i, d_vx, live)
    tl.store(partials + 2 * pixels + i, d_vxy, live)
    tl.store(sums + block, tl.sum(tl.where(live, weight - value, 0.0)))


@triton.jit
def _combine(
    image, target, half, weights, gradient, sums, window, rows, cols, pixels, blocks, soft, depth, share, ssim,
    KIND: tl.constexpr, WEIGHTED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Finish the blur of the derivatives and add those of the data term; sum w times that term of a block, the squares
    of w times the difference, and of w times the target."""
    block = tl.program_id(0)
    i = block * BLOCK + tl.arange(0, BLOCK)
    live = i < pixels
    row = i // cols
    px, pxx, pxy = tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32), tl.zeros((BLOCK,), tl.float32)
    for tap in tl.static_range(-_R, _R + 1):
        ok = live & (row + tap >= 0) & (row + tap < rows)
        weight, at = tl.load(window + (tap + _R)), half + i + tap * cols
        px += weight * tl.load(at, ok, 0.0)
        pxx += weight * tl.load(at + pixels, ok, 0.0)
        pxy += weight * tl.load(at + 2 * pixels, ok, 0.0)
    x, y = tl.load(image + i, live, 0.0), tl.load(target + i, live, 0.0)
    off = x - y
    if KIND == _L1:
        pull = tl.where(off > 0.0, 1.0, tl.where(off < 0.0, -1.0, 0.0))
        cost = tl.abs(off)
    else:
        pull = off * soft
        if KIND != _L2:
            pull = pull * tl.exp(-depth * tl.maximum(y, 0.0))
        cost = 0.5 * off * pull
    slope = px + 2.0 * x * pxx + y * pxy
    if WEIGHTED:
        weight = tl.load(weights + i, live, 0.0)
        off, y = off * weight, y * weight
        seen = weight > 0.0  # values in a pixel of weight 0 may overflow when squared
        pull, cost = tl.where(seen, pull * weight, 0.0), tl.where(seen, cost * weight, 0.0)
        slope = tl.where(seen, slope, 0.0)
    tl.store(gradient + i, share * pull - ssim * slope, live)
    tl.store(sums + block, tl.sum(cost))
    tl.store(sums + blocks + block, tl.sum(off * off))
    tl.store(sums + 2 * blocks + block, tl.sum(y * y))


class GpuProjectionLoss:
    """mean w (D(x, y) + λ (1 - SSIM(x, y))) and its gradient, see `cpu.losses.CpuProjectionLoss`."""

    def __init__(
        self, shape: tuple[int, int], ssim_weight: float, device: torch.device, term: DataTerm = ABSOLUTE
    ) -> None:
        self.shape, self.pixels, self.ssim_weight, self.term = shape, shape[0] * shape[1], ssim_weight, term
        self.window = torch.from_numpy(gaussian_window()).to(device)
        self._blocks = triton.cdiv(self.pixels, _BLOCK)
        self._half = torch.empty((3, *shape), device=device)
        self._partials = torch.empty((3, *shape), device=device)

    def target_maps(self, target: Tensor, weights: Tensor | None = None) -> Tensor:
        """Blurred m y and m y² [2, row, col] of a target image, m where the weight is above 0."""
        seen = target if weights is None else target * (weights > 0)
        maps = torch.stack((seen, seen * seen))
        return self._blurred(self._blurred(maps, across=True), across=False)

    def _blurred(self, maps: Tensor, *, across: bool) -> Tensor:
        out = torch.empty_like(maps)
        _blur[(self._blocks, maps.shape[0])](
            maps, out, self.window, *self.shape, self.pixels, ACROSS=across, BLOCK=_BLOCK
        )
        return out

    def __call__(
        self, image: Tensor, target: Tensor, target_maps: Tensor, weights: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The loss (float64 scalar on the device; reading it waits for the device), and its gradient.

        `target_maps` must be made with the same weights. Image and target must be finite, also in pixels of weight 0.
        """
        gradient, sums = self.slope(image, target, target_maps, weights)
        return (sums[1] + self.ssim_weight * sums[0]) / self.pixels, gradient

    def slope(
        self, image: Tensor, target: Tensor, target_maps: Tensor, weights: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """The gradient, and float64 sums [4]: w (1 - SSIM), w times the data term, squares of w times the difference
        and of w times the target."""
        (rows, cols), pixels, grid = self.shape, self.pixels, (self._blocks,)
        gradient, sums = torch.empty_like(image), image.new_empty((4, self._blocks))
        weighted = weights is not None
        w = image if weights is None else weights  # not read without weights
        _products_across[grid](
            image, target, w, self._half, self.window, cols, pixels, WEIGHTED=weighted, BLOCK=_BLOCK
        )  # fmt: skip
        _ssim_terms[grid](
            self._half, target_maps, w, self._partials, sums[0], self.window, rows, cols, pixels, *_C,
            WEIGHTED=weighted, BLOCK=_BLOCK,
        )  # fmt: skip
        _blur[(self._blocks, 3)](self._partials, self._half, self.window, rows, cols, pixels, ACROSS=True, BLOCK=_BLOCK)
        _combine[grid](
            image, target, self._half, w, gradient, sums[1], self.window, rows, cols, pixels, self._blocks,
            1 / self.term.delta, self.term.depth, 1 / pixels, self.ssim_weight / pixels,
            KIND=self.term.kind, WEIGHTED=weighted, BLOCK=_BLOCK,
        )  # fmt: skip
        return gradient, sums.sum(1, dtype=torch.float64)


@triton.jit
def _slope(here, other, ok):
    """|other - here| and its derivative by `here`; 0 if there is no neighbour."""
    step = other - here
    sign = tl.where(step > 0.0, 1.0, tl.where(step < 0.0, -1.0, 0.0))
    return tl.where(ok, tl.abs(step), 0.0), tl.where(ok, -sign, 0.0)


@triton.jit
def _total_variation(volume, gradient, sums, weight, nz, ny, nx, voxels, BLOCK: tl.constexpr):
    block = tl.program_id(0)
    i = block.to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < voxels
    x, y, z = i % nx, (i // nx) % ny, i // nx // ny
    here = tl.load(volume + i, live, 0.0)
    stride_z = ny * nx
    after_x, before_x = live & (x + 1 < nx), live & (x > 0)
    after_y, before_y = live & (y + 1 < ny), live & (y > 0)
    after_z, before_z = live & (z + 1 < nz), live & (z > 0)
    amount_x, slope_x = _slope(here, tl.load(volume + i + 1, after_x, 0.0), after_x)
    amount_y, slope_y = _slope(here, tl.load(volume + i + nx, after_y, 0.0), after_y)
    amount_z, slope_z = _slope(here, tl.load(volume + i + stride_z, after_z, 0.0), after_z)
    _, back_x = _slope(here, tl.load(volume + i - 1, before_x, 0.0), before_x)
    _, back_y = _slope(here, tl.load(volume + i - nx, before_y, 0.0), before_y)
    _, back_z = _slope(here, tl.load(volume + i - stride_z, before_z, 0.0), before_z)
    slope = slope_x + slope_y + slope_z + back_x + back_y + back_z
    tl.store(gradient + i, tl.load(weight) * slope, live)
    tl.store(sums + block, tl.sum(amount_x + amount_y + amount_z))


def total_variation(volume: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """weight * mean |difference of neighbours| over the three axes (float64 scalar), and its gradient."""
    per_pair = weight / max(1, neighbours(volume.shape))
    total, gradient = variation(volume, torch.tensor(per_pair, dtype=torch.float32).to(volume.device))
    return total * per_pair, gradient


def neighbours(shape: Sequence[int]) -> int:
    """Number of pairs of neighbours along the three axes of a volume [z, y, x]."""
    nz, ny, nx = shape
    return (nz - 1) * ny * nx + nz * (ny - 1) * nx + nz * ny * (nx - 1)


def variation(volume: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The sum of |difference of neighbours| (float64 scalar), and its gradient times a weight on the device."""
    blocks = triton.cdiv(volume.numel(), _BLOCK)
    gradient, sums = torch.empty_like(volume), volume.new_empty(blocks)
    _total_variation[(blocks,)](volume, gradient, sums, weight, *volume.shape, volume.numel(), BLOCK=_BLOCK)
    return sums.sum(dtype=torch.float64), gradient
