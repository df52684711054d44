"""The part of a step for each Gaussian (Triton): raw to physical parameters, gradients, and Adam's update."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from recon.kernels.cpu.adam import BETA1, BETA2

_BLOCK = 128
_WIDEST = torch.finfo(torch.float32).max
_EPS = 1e-15  # epsilon of Adam
_SHORTEST = tl.constexpr(1e-12)  # a shorter quaternion counts as the identity
_FARTHEST = tl.constexpr(87.0)  # largest |x| for which e^x is a normal float32 number


@triton.jit
def _softplus(r):
    """log(1 + e^r), without overflow or cancellation, see `cpu.activation`."""
    t = tl.exp(-tl.minimum(tl.abs(r), _FARTHEST))
    z = t / (t + 2.0)
    w = z * z
    series = w * (w * (w * (w * (w * (1.0 / 13.0) + 1.0 / 11.0) + 1.0 / 9.0) + 1.0 / 7.0) + 1.0 / 5.0) + 1.0 / 3.0
    return tl.maximum(r, 0.0) + 2.0 * z * (w * series + 1.0)


@triton.jit
def _sigmoid(r):
    """Derivative of softplus, accurate also for very negative r."""
    t = tl.exp(-tl.minimum(tl.abs(r), _FARTHEST))
    return tl.where(r >= 0.0, 1.0, t) / (1.0 + t)


@triton.jit
def _unit_quaternion(quaternions, i, live):
    w, x = tl.load(quaternions + 4 * i, live, 1.0), tl.load(quaternions + 4 * i + 1, live, 0.0)
    y, z = tl.load(quaternions + 4 * i + 2, live, 0.0), tl.load(quaternions + 4 * i + 3, live, 0.0)
    # Divide by the largest component first, because the square of 1e-30 underflows in float32.
    most = tl.maximum(tl.maximum(tl.abs(w), tl.abs(x)), tl.maximum(tl.abs(y), tl.abs(z)))
    scale = tl.where(most > 0.0, most, 1.0)
    w, x, y, z = w / scale, x / scale, y / scale, z / scale
    length = tl.sqrt(w * w + x * x + y * y + z * z)
    norm = length * scale
    turned = norm > _SHORTEST
    length = tl.where(turned, length, 1.0)
    w, x = tl.where(turned, w / length, 1.0), tl.where(turned, x / length, 0.0)
    y, z = tl.where(turned, y / length, 0.0), tl.where(turned, z / length, 0.0)
    return w, x, y, z, norm, turned


@triton.jit(do_not_specialize=["n"])
def _activate(log_scales, quaternions, raw, scales, rotations, densities, unit, n, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    for k in tl.static_range(3):
        log_scale = tl.minimum(tl.maximum(tl.load(log_scales + 3 * i + k, live, 0.0), -_FARTHEST), _FARTHEST)
        tl.store(scales + 3 * i + k, tl.exp(log_scale), live)
    tl.store(densities + i, unit * _softplus(tl.load(raw + i, live, 0.0)), live)
    w, x, y, z, _, _ = _unit_quaternion(quaternions, i, live)
    tl.store(rotations + 9 * i, 1.0 - 2.0 * (y * y + z * z), live)
    tl.store(rotations + 9 * i + 1, 2.0 * (x * y - w * z), live)
    tl.store(rotations + 9 * i + 2, 2.0 * (x * z + w * y), live)
    tl.store(rotations + 9 * i + 3, 2.0 * (x * y + w * z), live)
    tl.store(rotations + 9 * i + 4, 1.0 - 2.0 * (x * x + z * z), live)
    tl.store(rotations + 9 * i + 5, 2.0 * (y * z - w * x), live)
    tl.store(rotations + 9 * i + 6, 2.0 * (x * z - w * y), live)
    tl.store(rotations + 9 * i + 7, 2.0 * (y * z + w * x), live)
    tl.store(rotations + 9 * i + 8, 1.0 - 2.0 * (x * x + y * y), live)


def activate(log_scales: Tensor, quaternions: Tensor, raw: Tensor, unit: float) -> tuple[Tensor, Tensor, Tensor]:
    """Scales [n, 3], rotations [n, 9] (row-major) and densities [n]; logarithms are clamped to +-87."""
    n = raw.shape[0]
    scales, rotations, densities = torch.empty_like(log_scales), raw.new_empty((n, 9)), torch.empty_like(raw)
    grid = (triton.cdiv(n, _BLOCK),)
    if n > 0:
        _activate[grid](log_scales, quaternions, raw, scales, rotations, densities, unit, n, BLOCK=_BLOCK)
    return scales, rotations, densities


@triton.jit(do_not_specialize=["n"])
def _activation_backward(
    quaternions, raw, d_rotations, d_densities, d_quaternions, d_raw, unit, n, BLOCK: tl.constexpr
):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    slope = unit * _sigmoid(tl.load(raw + i, live, 0.0))
    tl.store(d_raw + i, tl.load(d_densities + i, live, 0.0) * slope, live)
    w, x, y, z, norm, turned = _unit_quaternion(quaternions, i, live)
    g = d_rotations + 9 * i
    g0, g1, g2 = tl.load(g, live, 0.0), tl.load(g + 1, live, 0.0), tl.load(g + 2, live, 0.0)
    g3, g4, g5 = tl.load(g + 3, live, 0.0), tl.load(g + 4, live, 0.0), tl.load(g + 5, live, 0.0)
    g6, g7, g8 = tl.load(g + 6, live, 0.0), tl.load(g + 7, live, 0.0), tl.load(g + 8, live, 0.0)
    gw = 2.0 * (z * (g3 - g1) + y * (g2 - g6) + x * (g7 - g5))
    gx = 2.0 * (y * (g1 + g3) + z * (g2 + g6) + w * (g7 - g5)) - 4.0 * x * (g4 + g8)
    gy = 2.0 * (x * (g1 + g3) + z * (g5 + g7) + w * (g2 - g6)) - 4.0 * y * (g0 + g8)
    gz = 2.0 * (x * (g2 + g6) + y * (g5 + g7) + w * (g3 - g1)) - 4.0 * z * (g0 + g4)
    # Only the part orthogonal to the unit quaternion rotates; the part along it would change the length.
    along = gw * w + gx * x + gy * y + gz * z
    per = tl.where(turned, 1.0 / tl.where(turned, norm, 1.0), 0.0)
    tl.store(d_quaternions + 4 * i, per * (gw - along * w), live)
    tl.store(d_quaternions + 4 * i + 1, per * (gx - along * x), live)
    tl.store(d_quaternions + 4 * i + 2, per * (gy - along * y), live)
    tl.store(d_quaternions + 4 * i + 3, per * (gz - along * z), live)


def activation_backward(
    quaternions: Tensor, raw: Tensor, unit: float, d_rotations: Tensor, d_densities: Tensor
) -> tuple[Tensor, Tensor]:
    """Gradients of quaternions [n, 4] and raw densities [n], computed from the gradients of rotations [n, 9] and
    densities [n]."""
    n = raw.shape[0]
    d_quaternions, d_raw = torch.empty_like(quaternions), torch.empty_like(raw)
    if n > 0:
        _activation_backward[(triton.cdiv(n, _BLOCK),)](
            quaternions, raw, d_rotations, d_densities, d_quaternions, d_raw, unit, n, BLOCK=_BLOCK
        )
    return d_quaternions, d_raw


@triton.jit
def _adam_one(parameter, gradient, first, second, rate, low, high, scale2, eps, b1, b2, size, BLOCK: tl.constexpr):
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = i < size
    g = tl.load(gradient + i, live, 0.0)
    m = b1 * tl.load(first + i, live, 0.0) + (1.0 - b1) * g
    v = b2 * tl.load(second + i, live, 0.0) + (1.0 - b2) * g * g
    tl.store(first + i, m, live)
    tl.store(second + i, v, live)
    value = tl.load(parameter + i, live, 0.0) - rate * m / (tl.sqrt(v * scale2) + eps)
    tl.store(parameter + i, tl.minimum(tl.maximum(value, low), high), live)


@triton.jit(do_not_specialize=["size0", "size1", "size2", "size3"])
def _adam(
    p0, g0, m0, v0, low0, high0, size0, p1, g1, m1, v1, low1, high1, size1,
    p2, g2, m2, v2, low2, high2, size2, p3, g3, m3, v3, low3, high3, size3,
    rates, go, eps, b1, b2, GUARDED: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    # One launch for all four arrays; the second axis of the grid selects the array.
    which = tl.program_id(1)
    rate, scale2 = tl.load(rates + which), tl.load(rates + 4)
    if GUARDED:
        alive = tl.load(go)
        size0, size1, size2, size3 = size0 * alive, size1 * alive, size2 * alive, size3 * alive
    if which == 0:
        _adam_one(p0, g0, m0, v0, rate, low0, high0, scale2, eps, b1, b2, size0, BLOCK)
    elif which == 1:
        _adam_one(p1, g1, m1, v1, rate, low1, high1, scale2, eps, b1, b2, size1, BLOCK)
    elif which == 2:
        _adam_one(p2, g2, m2, v2, rate, low2, high2, scale2, eps, b1, b2, size2, BLOCK)
    else:
        _adam_one(p3, g3, m3, v3, rate, low3, high3, scale2, eps, b1, b2, size3, BLOCK)


def adam_rates(rates: Sequence[float], step: int) -> list[float]:
    """Input of `adam_by`: the rates with the correction of the first moment, and the correction of the second.

    Steps count from 1.
    """
    return [*(rate / (1 - BETA1**step) for rate in rates), 1 / (1 - BETA2**step)]


def adam(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    rates: Sequence[float],
    step: int,
    bounds: Sequence[tuple[float, float] | None],
) -> None:
    """Update four arrays and their moments in place (Kingma & Ba 2015, algorithm 1) and keep them within bounds.

    `step` counts from 1.
    """
    corrected = torch.tensor(adam_rates(rates, step), dtype=torch.float32).to(parameters[0].device)
    adam_by(parameters, gradients, first, second, corrected, bounds)


def adam_by(
    parameters: Sequence[Tensor],
    gradients: Sequence[Tensor],
    first: Sequence[Tensor],
    second: Sequence[Tensor],
    rates: Tensor,
    bounds: Sequence[tuple[float, float] | None],
    go: Tensor | None = None,
) -> None:
    """`adam` with the five numbers of `adam_rates` on the device; if `go` is 0, nothing changes."""
    arguments: list[Tensor | float | int] = []
    for p, g, m, v, within in zip(parameters, gradients, first, second, bounds, strict=True):
        low, high = (-_WIDEST, _WIDEST) if within is None else within
        arguments += [p, g, m, v, low, high, p.numel()]
    largest = max(p.numel() for p in parameters)
    if largest > 0:
        block = 4 * _BLOCK
        _adam[(triton.cdiv(largest, block), 4)](
            *arguments, rates, rates if go is None else go, _EPS, BETA1, BETA2, GUARDED=go is not None, BLOCK=block
        )  # fmt: skip


@triton.jit(do_not_specialize=["n"])
def _add_lengths(vectors, sums, go, factor, n, GUARDED: tl.constexpr, BLOCK: tl.constexpr):
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    if GUARDED:
        n = n * tl.load(go)
    live = i < n
    x, y = tl.load(vectors + 2 * i, live, 0.0), tl.load(vectors + 2 * i + 1, live, 0.0)
    tl.store(sums + i, tl.load(sums + i, live, 0.0) + factor * tl.sqrt(x * x + y * y), live)


def add_lengths(vectors: Tensor, factor: float, sums: Tensor, go: Tensor | None = None) -> None:
    """sums [n] += factor |vectors [n, 2]|, unless `go` on the device is 0."""
    n = sums.shape[0]
    if n > 0:
        _add_lengths[(triton.cdiv(n, _BLOCK),)](
            vectors, sums, sums if go is None else go, factor, n, GUARDED=go is not None, BLOCK=_BLOCK
        )  # fmt: skip
