"""Fourier shell correlation: the resolution at which two volumes, from half of the views each, still agree."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from recon.base.arrays import F64

_EDGE = 0.2  # of the half axis
_TAPERED_FROM = 8  # voxels; a shorter axis is too short for a soft edge


@dataclass(frozen=True, eq=False)
class ShellCorrelation:
    """Correlation of two volumes by spatial frequency.

    Attributes:
        frequency: [shell], 1/mm, the middle of each shell; the first is one period over the longest edge.
        correlation: [shell], -1..1; NaN in a shell where a volume has no power.
        independent: [shell], number of independent Fourier values in a shell. For white noise the correlation
            scatters about 0 with a standard deviation of 1/sqrt(independent), or up to 30 % less under a mask.
        nyquist: 1/mm, of the coarsest voxel edge; shells end there.
    """

    frequency: F64
    correlation: F64
    independent: F64
    nyquist: float

    @property
    def half_bit(self) -> F64:
        """[shell]: the correlation that leaves half a bit of information a voxel (van Heel & Schatz 2005, eq. 17)."""
        root = np.sqrt(self.independent)
        return (0.2071 + 1.9102 / root) / (1.2071 + 0.9102 / root)

    @property
    def resolution_mm(self) -> float:
        """Full period, in mm, at the half-bit criterion; see `crossing`."""
        return self.crossing(self.half_bit)

    def crossing(self, threshold: F64) -> float:
        """Full period, in mm, at which the correlation first falls below `threshold` [shell].

        Between two shells the crossing is interpolated. If the correlation never falls below, it is the Nyquist period:
        the voxels are the limit, not the data. Infinite if already the first shell lies below.
        """
        above = np.nan_to_num(self.correlation, nan=-1.0) - threshold
        below = np.flatnonzero(above < 0)
        if below.size == 0:
            return 1 / self.nyquist
        first = int(below[0])
        if first == 0:
            return float("inf")
        before, after = float(above[first - 1]), float(above[first])
        share = before / (before - after)
        return 1 / float(self.frequency[first - 1] + share * (self.frequency[first] - self.frequency[first - 1]))


def soft_cylinder(shape: tuple[int, int, int]) -> NDArray[np.float32]:
    """A mask [z, y, x]: 1 inside the cylinder that every view sees, with a raised-cosine edge to 0.

    The edge takes a fifth of the half axis, along the radius and along z. Without it the outline of the field, which
    both volumes share, correlates at every frequency.
    """
    nz, ny, nx = shape
    along = np.abs(_centred(nz)) if nz >= _TAPERED_FROM else np.zeros(nz)
    radius = np.hypot(_centred(ny)[:, None] * ny, _centred(nx)[None, :] * nx) / min(ny, nx)
    return (_fall(along)[:, None, None] * _fall(radius)[None]).astype(np.float32)


def _centred(n: int) -> F64:
    """Voxel centres in half widths, -1..1."""
    return (2 * np.arange(n) + 1 - n) / n


def _fall(distance: F64) -> F64:
    """1 inside, 0 beyond a distance of 1, half a period of a cosine between."""
    return 0.5 + 0.5 * np.cos(np.pi * np.clip((distance - 1 + _EDGE) / _EDGE, 0, 1))


def fourier_shell_correlation(
    first: NDArray[np.floating],
    second: NDArray[np.floating],
    spacing: float | tuple[float, float, float] = 1.0,
    mask: NDArray[np.floating] | None = None,
) -> ShellCorrelation:
    """Correlation of two volumes shell by shell in Fourier space (Harauz & van Heel 1986).

        FSC(k) = Re Σ F₁ F₂* / sqrt(Σ |F₁|² Σ |F₂|²), sums over the shell of radius k

    Each volume's mean (within the mask) is subtracted first, so that neither gain nor offset matters. Errors common to
    both reconstructions (the same prior, mask or ring artefact) count as agreement, so the resolution is an optimistic
    bound.

    Args:
        first, second: [z, y, x], of one shape; edges may differ in length.
        spacing: voxel edge in mm, or the edges (z, y, x).
        mask: weights [z, y, x], such as `soft_cylinder`; None: all 1.

    Raises:
        ValueError: for fewer than 4 voxels along the longest axis, values that are not finite, or a volume that is
            constant under the mask.
    """
    shape: tuple[int, int, int] = first.shape
    edges = np.broadcast_to(np.asarray(spacing, np.float64), (3,))
    if max(shape) < 4:
        raise ValueError(f"volumes of {shape} voxels have no shells to compare")
    width = 1 / float(max(n * edge for n, edge in zip(shape, edges, strict=True)))
    nyquist = float(min(0.5 / edge for n, edge in zip(shape, edges, strict=True) if n > 1))
    shells = max(1, int(np.floor(nyquist / width + 1e-9)))
    weights = np.ones(shape) if mask is None else mask
    spectra = _spectrum(first, weights), _spectrum(second, weights)
    cross, one, other, voxels = _sums_of_shells(*spectra, shape, edges, width, shells)
    power = np.sqrt(one * other)
    correlation = np.divide(cross, power, out=np.full(shells + 1, np.nan), where=power > 0)
    used = voxels > 0
    used[0] = False  # the mean was subtracted
    return ShellCorrelation(
        frequency=np.float64(width) * np.arange(shells + 1, dtype=np.float64)[used],
        correlation=np.clip(correlation[used], -1, 1),
        independent=np.maximum(1.0, voxels[used] * _independent_share(weights)),
        nyquist=nyquist,
    )


def _sums_of_shells(
    a: NDArray[np.complex64],
    b: NDArray[np.complex64],
    shape: tuple[int, int, int],
    edges: F64,
    width: float,
    shells: int,
) -> F64:
    """Sums [4, shell] of F₁ F₂*, |F₁|², |F₂|² and ones, of two real volumes of this shape, over shells of this width
    (1/mm)."""
    kz, ky = (np.fft.fftfreq(n, edge) for n, edge in zip(shape[:2], edges[:2], strict=True))
    kx = np.fft.rfftfreq(shape[2], edges[2])
    twice = np.full(kx.size, 2.0)  # only half of a real volume's transform is stored; the other half is its conjugate
    twice[0] = 1
    if shape[2] % 2 == 0:
        twice[-1] = 1
    in_plane = ky[:, None] ** 2 + kx[None, :] ** 2
    weight = np.broadcast_to(twice, in_plane.shape).ravel()
    sums = np.zeros((4, shells + 1))
    for k, height in enumerate(kz):
        shell = np.rint(np.sqrt(in_plane + height**2) / width).astype(np.int64).ravel()
        inside = np.flatnonzero(shell <= shells)
        index, w = shell[inside], weight[inside]
        x, y = a[k].ravel()[inside], b[k].ravel()[inside]
        for total, values in zip(sums, ((x * y.conj()).real, np.abs(x) ** 2, np.abs(y) ** 2, 1.0), strict=True):
            total += np.bincount(index, w * values, shells + 1)
    return sums


def _spectrum(volume: NDArray[np.floating], mask: NDArray[np.floating]) -> NDArray[np.complex64]:
    """Fourier transform [z, y, x // 2 + 1] of the masked volume, without its mean, scaled to a maximum of 1."""
    data = np.asarray(volume, np.float64)
    if not np.isfinite(data).all():
        raise ValueError(f"{int((~np.isfinite(data)).sum())} of {data.size} voxels are not finite")
    data = (data - np.average(data, weights=mask)) * mask
    scale = float(np.abs(data).max())
    # A constant without its mean is rounding noise, which has no meaningful correlation.
    if scale <= 1e-12 * max(float(np.abs(volume).max()), 1e-300):
        raise ValueError("a volume is constant under the mask; there is nothing to correlate")
    return np.asarray(fft.rfftn((data / scale).astype(np.float32), workers=-1), np.complex64)


def _independent_share(mask: NDArray[np.floating]) -> float:
    """Fraction of the Fourier values of masked noise that are independent: (Σ w²)² / (N Σ w⁴).

    By Parseval the cross term of two noises over all frequencies scatters as sqrt(Σ w⁴), against a bound of Σ w².
    Within one thin shell slightly more are independent, so thresholds are a little too strict, never too lax.
    """
    square = np.asarray(mask, np.float64) ** 2
    return float(square.sum() ** 2 / (square.size * (square**2).sum()))
