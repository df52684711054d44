"""Rays: exact line integrals in a cone, for Gaussians whose affine footprint is not accurate enough (numba).

With H = S⁻¹Rᵀ, t from the source to the centre and D along the ray of a pixel, a Gaussian's integral along a line is

    V = ρ sqrt(2π) |D| / |H D| exp(-1/2 |H t x H D|² / |H D|²)

As a function of the offset δ of the pixel from that of the centre, it is the affine footprint with three more numbers.
At the depth of the centre, H D = e + y with e = H t and y linear in δ. The quadratic form of the footprint, N = δᵀKδ,
is the square of the part of y across e. The part of y along e is α·δ. So

    V = W (|D| / |D₀|) / sqrt(Q) exp(-1/2 N / Q),   Q = (1 + α·δ)² + η N,   η = 1 / |e|²,   α = η (e·Hu, e·Hv) tz / f

with W, K from `cpu.footprints`, D₀ the ray through the centre, and β·δ the first order of |D| / |D₀|. All these values
are sums of squares, which are accurate for thin Gaussians, too. Rays with N / Q <= c² pass within c standard
deviations. They fill an ellipse, which limits the columns of each row. If the Gaussian reaches the plane of the source,
whole rows are computed.

A compact kernel has (1 - N / (R² Q))₊² in place of the exponential and ends at c² = R².

The integral is over the whole line, also behind the source, so a Gaussian must not reach the source.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from recon.base.kernel import Kernel
from recon.kernels.cpu.activation import F32, OPTIONS
from recon.kernels.cpu.footprints import (
    HU,
    KV,
    SHEAR,
    K,
    RayCamera,
    U,
    V,
    W,
    footprint_table,
    footprints,
    footprints_backward,
)  # fmt: skip

F64 = NDArray[np.float64]
_f = np.float32
_BAND = 8  # rows per task; no two tasks write to the same pixel
# Columns of the terms: α, η, W |f / D₀|, the truncation c² and the box that it fills.
AU, AV, ETA, WEIGHT, CUT, ROW0, ROW1, COL0, COL1 = range(9)
_PER = np.float32(1 / Kernel.COMPACT.radius**2)
# Columns of the sums, with a = g V, b = g ∂V / ∂N, q = g ∂V / ∂Q, l = 1 + α·δ; b goes with τ = δu - r δv and δv.
A, BT, BV, BTT, BTV, BVV, L, LU, LV, N = range(10)


@njit(inline="always", fastmath=True)
def _decay(x):
    """e^x for x <= 0, accurate to 4e-6: e^(x / 32) by its series, squared five times. np.exp would prevent
    vectorisation."""
    t = max(x, _f(-40)) * _f(1 / 32)
    p = _f(1 / 120) + t * _f(1 / 720)
    p = _f(1) + t * (_f(1) + t * (_f(0.5) + t * (_f(1 / 6) + t * (_f(1 / 24) + t * p))))
    p = p * p
    p = p * p
    p = p * p
    p = p * p
    return p * p


@njit(inline="always", fastmath=True)
def _profile(x, compact):
    """G and D of `cpu.project` where N / Q = x."""
    if compact:
        t = max(_f(1) - x * _PER, _f(0))
        return t * t, t * (_f(4) * _PER)
    value = _decay(_f(-0.5) * x)
    return value, value


@njit(**OPTIONS)
def _terms(
    means: F32,
    scales: F32,
    rotations: F32,
    densities: F32,
    axes: F32,
    focal: float,
    sod: float,
    faint: float,
    cut: float,
    unit: float,
    ends: bool,
    rows: int,
    cols: int,
    table: F32,
    terms: F64,
) -> None:
    for i in prange(densities.shape[0]):
        for k in range(9):
            terms[i, k] = 0.0
        broadest = max(scales[i, 0], max(scales[i, 1], scales[i, 2]))
        most = densities[i] * unit * broadest  # the largest value on any ray
        if table[i, HU] < 0.0 or most <= faint:
            continue
        tx = ty = 0.0
        tz = sod
        for j in range(3):
            tx, ty, tz = tx + axes[0, j] * means[i, j], ty + axes[1, j] * means[i, j], tz + axes[2, j] * means[i, j]
        ax, ay = tx / tz, ty / tz
        hh = hu = hv = 0.0
        for k in range(3):
            pu = pv = pd = 0.0
            for j in range(3):
                r = rotations[i, 3 * j + k]
                pu, pv, pd = pu + axes[0, j] * r, pv + axes[1, j] * r, pd + axes[2, j] * r
            sharp = 1.0 / scales[i, k]
            h = (ax * pu + ay * pv + pd) * sharp
            hh, hu, hv = hh + h * h, hu + h * pu * sharp, hv + h * pv * sharp
        au, av, eta = hu / (hh * focal), hv / (hh * focal), 1.0 / (hh * tz * tz)
        c2 = cut * cut if ends else min(cut * cut, 2.0 * math.log(most / faint))
        terms[i, AU], terms[i, AV], terms[i, ETA], terms[i, CUT] = au, av, eta, c2
        terms[i, WEIGHT] = table[i, W] / math.sqrt(1.0 + ax * ax + ay * ay)
        # The conic N (1 - c²η) = c² (1 + α·δ)²: an ellipse unless the Gaussian reaches the source's plane.
        row0, row1, col0, col1 = 0.0, float(rows), 0.0, float(cols)
        kv, shear = 1.0 / table[i, KV], float(table[i, SHEAR])
        left = 1.0 - c2 * eta
        if left > 0.0:
            svv = kv / left
            suv, suu = shear * svv, (1.0 / table[i, K]) / left + shear * shear * svv
            gu, gv = suu * au + suv * av, suv * au + svv * av
            left = 1.0 - c2 * (au * gu + av * gv)
            if left > 0.0:
                mu, mv = table[i, U] + c2 * gu / left, table[i, V] + c2 * gv / left
                wide = math.sqrt(c2 / left * (suu + c2 * gu * gu / left))
                high = math.sqrt(c2 / left * (svv + c2 * gv * gv / left))
                row0, row1 = max(row0, math.ceil(mv - high)), min(row1, math.floor(mv + high) + 1.0)
                col0, col1 = max(col0, math.ceil(mu - wide)), min(col1, math.floor(mu + wide) + 1.0)
        if row0 < row1 and col0 < col1:
            terms[i, ROW0], terms[i, ROW1], terms[i, COL0], terms[i, COL1] = row0, row1, col0, col1


@njit(inline="always", fastmath=True)
def _span(table, terms, i, row):
    """Columns first..last (excluded) of a row that lie within the conic."""
    au, av, c2 = terms[i, AU], terms[i, AV], terms[i, CUT]
    dv = row - float(table[i, V])
    left, k, shear = 1.0 - c2 * terms[i, ETA], float(table[i, K]), float(table[i, SHEAR])
    # (left k - c² αu²) δu² - 2 half δu + rest <= 0 with δu measured from the middle of the affine footprint's row.
    line = 1.0 + (av + au * shear) * dv
    square, half = left * k - c2 * au * au, c2 * au * line
    rest = left * table[i, KV] * dv * dv - c2 * line * line
    first, last = terms[i, COL0], terms[i, COL1]
    if square > 0.0:
        under = half * half - square * rest
        if under <= 0.0:
            return 0, 0
        middle = float(table[i, U]) + shear * dv + half / square
        reach = math.sqrt(under) / square
        first, last = max(first, math.ceil(middle - reach)), min(last, math.floor(middle + reach) + 1.0)
    return int(first), int(last)


# `compact` is a constant of the compiled kernels, as the profile in `cpu.project`.
def _renderer(compact: bool) -> Any:
    @njit(**OPTIONS)
    def kernel(table: F32, terms: F64, focal: float, col: float, row: float, image: F32) -> None:
        rows = image.shape[0]
        for band in prange((rows + _BAND - 1) // _BAND):
            per = _f(1 / focal)
            for i in range(table.shape[0]):
                au, av, eta, weight = _f(terms[i, AU]), _f(terms[i, AV]), _f(terms[i, ETA]), _f(terms[i, WEIGHT])
                k, shear, kv, u = table[i, K], table[i, SHEAR], table[i, KV], table[i, U]
                for r in range(max(band * _BAND, int(terms[i, ROW0])), min((band + 1) * _BAND, int(terms[i, ROW1]))):
                    first, last = _span(table, terms, i, r)
                    if first >= last:
                        continue
                    line = image[r, first:last]
                    dv, du0 = _f(r) - table[i, V], _f(first) - u
                    up, over0 = _f(r - row) * per, _f(first - col) * per
                    tall, up2, along = kv * dv * dv, _f(1) + up * up, _f(1) + av * dv
                    for j in range(line.shape[0]):
                        du, over = du0 + _f(j), over0 + _f(j) * per
                        across = du - shear * dv
                        n = k * across * across + tall
                        lift = along + au * du
                        inverse = _f(1) / (lift * lift + eta * n)
                        value, _ = _profile(n * inverse, compact)
                        line[j] += weight * np.sqrt((up2 + over * over) * inverse) * value

    return kernel


def _summer(compact: bool) -> Any:
    @njit(**OPTIONS)
    def kernel(table: F32, terms: F64, focal: float, col: float, row: float, gradient: F32, sums: F32) -> None:
        for i in prange(table.shape[0]):
            per = _f(1 / focal)
            au, av, eta, weight = _f(terms[i, AU]), _f(terms[i, AV]), _f(terms[i, ETA]), _f(terms[i, WEIGHT])
            k, shear, kv, u = table[i, K], table[i, SHEAR], table[i, KV], table[i, U]
            for m in range(10):
                sums[i, m] = _f(0)
            for r in range(int(terms[i, ROW0]), int(terms[i, ROW1])):
                first, last = _span(table, terms, i, r)
                if first >= last:
                    continue
                line = gradient[r, first:last]
                dv, du0 = _f(r) - table[i, V], _f(first) - u
                up, over0 = _f(r - row) * per, _f(first - col) * per
                tall, up2, along = kv * dv * dv, _f(1) + up * up, _f(1) + av * dv
                s = sb = sbt = sbtt = sl = slu = sn = _f(0)
                for j in range(line.shape[0]):
                    du, over = du0 + _f(j), over0 + _f(j) * per
                    across = du - shear * dv
                    n = k * across * across + tall
                    lift = along + au * du
                    inverse = _f(1) / (lift * lift + eta * n)
                    value, slope = _profile(n * inverse, compact)
                    under = line[j] * weight * np.sqrt((up2 + over * over) * inverse)
                    a, steep = under * value, under * slope
                    aq = _f(0.5) * inverse * (n * inverse * steep - a)
                    ab, al = eta * aq - _f(0.5) * inverse * steep, lift * aq
                    s += a
                    sb += ab
                    sbt += ab * across
                    sbtt += ab * across * across
                    sl += al
                    slu += al * du
                    sn += aq * n
                sums[i, A] += s
                sums[i, BT] += sbt
                sums[i, BV] += sb * dv
                sums[i, BTT] += sbtt
                sums[i, BTV] += sbt * dv
                sums[i, BVV] += sb * dv * dv
                sums[i, L] += sl
                sums[i, LU] += slu
                sums[i, LV] += sl * dv
                sums[i, N] += sn

    return kernel


_RENDER = {kernel: _renderer(kernel.is_compact) for kernel in Kernel}
_SUMS = {kernel: _summer(kernel.is_compact) for kernel in Kernel}


@njit(**OPTIONS)
def _as_moments(table: F32, terms: F64, sums: F32, moments: F32) -> None:
    """Moments that give an affine footprint the same gradient through W, K and the centre."""
    for i in prange(table.shape[0]):
        for m in range(6):
            moments[i, m] = _f(0)
        if table[i, HU] < 0:
            continue
        per_w = -2.0 / table[i, W]
        moments[i, 0] = -0.5 * per_w * sums[i, A]
        # Σ₂α along τ and v, without the large terms of Σ₂ that cancel in τ.
        along_t = terms[i, AU] / table[i, K]
        along_v = (table[i, SHEAR] * terms[i, AU] + terms[i, AV]) / table[i, KV]
        moments[i, 1] = per_w * (sums[i, BT] + sums[i, L] * along_t)
        moments[i, 2] = per_w * (sums[i, BV] + sums[i, L] * along_v)
        moments[i, 3], moments[i, 4] = per_w * sums[i, BTT], per_w * sums[i, BTV]
        moments[i, 5] = per_w * sums[i, BVV]


@njit(**OPTIONS)
def _bend(
    terms: F64,
    sums: F32,
    means: F32,
    scales: F32,
    rotations: F32,
    axes: F32,
    focal: float,
    sod: float,
    d_means: F32,
    d_log_scales: F32,
    d_rotations: F32,
) -> None:
    """Add the gradient through α, η and |D₀|, which an affine footprint does not have."""
    for i in prange(means.shape[0]):
        if terms[i, ROW0] >= terms[i, ROW1]:
            continue
        tx = ty = 0.0
        tz = sod
        for j in range(3):
            tx, ty, tz = tx + axes[0, j] * means[i, j], ty + axes[1, j] * means[i, j], tz + axes[2, j] * means[i, j]
        ax, ay = tx / tz, ty / tz
        power = 1.0 + ax * ax + ay * ay
        hh = 1.0 / (terms[i, ETA] * tz * tz)
        geta = float(sums[i, N]) * terms[i, ETA]
        gau, gav = 2.0 * sums[i, LU], 2.0 * sums[i, LV]
        along = -2.0 * (gau * terms[i, AU] + gav * terms[i, AV] + geta) / hh
        gau, gav = gau / (focal * hh), gav / (focal * hh)
        gax, gay = -sums[i, A] * ax / power, -sums[i, A] * ay / power
        for k in range(3):
            pu = pv = pd = 0.0
            for j in range(3):
                r = rotations[i, 3 * j + k]
                pu, pv, pd = pu + axes[0, j] * r, pv + axes[1, j] * r, pd + axes[2, j] * r
            sharp = 1.0 / scales[i, k]
            xu, xv, h = pu * sharp, pv * sharp, (ax * pu + ay * pv + pd) * sharp
            gh, gxu, gxv = gau * xu + gav * xv + along * h, gau * h, gav * h
            d_log_scales[i, k] -= _f(gh * h + gxu * xu + gxv * xv)
            gax, gay = gax + gh * xu, gay + gh * xv
            gpu, gpv, gpd = (gh * ax + gxu) * sharp, (gh * ay + gxv) * sharp, gh * sharp
            for j in range(3):
                d_rotations[i, 3 * j + k] += _f(axes[0, j] * gpu + axes[1, j] * gpv + axes[2, j] * gpd)
        gz = -(gax * ax + gay * ay + 2.0 * geta) / tz
        for j in range(3):
            d_means[i, j] += _f((axes[0, j] * gax + axes[1, j] * gay) / tz + axes[2, j] * gz)


class CpuRays:
    """Gaussians in one view of a cone, integrated ray by ray, with forward and backward pass."""

    def __init__(
        self,
        parameters: tuple[F32, F32, F32, F32],
        camera: RayCamera,
        shape: tuple[int, int],
        faint: float,
        cut: float,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> None:
        """Gaussians are cut off at `cut` standard deviations, and left out if no ray gets more than `faint` from them.

        `parameters` are means [n, 3], standard deviations [n, 3], rotations [n, 9] and densities [n].
        """
        self.parameters, self.camera, self._kernel = parameters, camera, kernel
        densities = parameters[3]
        self.table = footprint_table(densities.shape[0])
        footprints(*self.parameters, camera, faint, cut, self.table, kernel=kernel)
        self.terms = np.empty((densities.shape[0], 9))
        rows, cols = shape
        _terms(
            *self.parameters, camera.axes, camera.focal, camera.sod, faint, kernel.reach(cut), kernel.length,
            kernel.is_compact, rows, cols, self.table, self.terms,
        )  # fmt: skip

    def add_to(self, image: F32) -> None:
        """Add the Gaussians to image [row, col]."""
        c = self.camera
        _RENDER[self._kernel](self.table, self.terms, c.focal, c.col, c.row, image)

    def backward(
        self, gradient: F32, d_means: F32, d_log_scales: F32, d_rotations: F32, d_densities: F32, d_centres: F32
    ) -> None:
        """Add to the gradients; d_centres [n, 2] receives ∂/∂(col, row) of the footprint's centre in 1/px."""
        means, scales, rotations, _ = self.parameters
        c = self.camera
        sums = np.empty((means.shape[0], 10), np.float32)
        _SUMS[self._kernel](self.table, self.terms, c.focal, c.col, c.row, gradient, sums)
        moments = np.empty((means.shape[0], 6), np.float32)
        _as_moments(self.table, self.terms, sums, moments)
        footprints_backward(
            self.table, moments, *self.parameters, c, d_means, d_log_scales, d_rotations, d_densities, d_centres,
            kernel=self._kernel,
        )  # fmt: skip
        _bend(
            self.terms, sums, means, scales, rotations, c.axes, c.focal, c.sod, d_means, d_log_scales, d_rotations
        )  # fmt: skip
