"""Gaussians: a volume as a sum of anisotropic kernels, with unconstrained raw parameters."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from recon.base.declared_types import check_arguments, check_settings
from recon.base.geometry import Geometry
from recon.base.kernel import Kernel
from recon.base.registry import LibraryError, loaded

if TYPE_CHECKING:
    from torch import Tensor

_FAINTEST_DENSITY = 1e-30  # smallest density, in density units
_PARAMETERS = {"means": (3,), "log_scales": (3,), "quaternions": (4,), "raw_densities": ()}


@dataclass(frozen=True, eq=False)
class Gaussians:
    """A sum of Gaussians: σ(x) = Σ_i ρ_i f((x - p_i)ᵀ Σ_i⁻¹ (x - p_i)), Σ = R S² Rᵀ, f(q) = exp(-q/2) (Zha et al.
    2024).

    With a kernel f other than exp(-q/2), the elements of the sum are still called Gaussians, and S still contains their
    standard deviations. The density of a Gaussian is a factor times `density_unit`. A raw density determines
    this factor, so raw densities and their learning rates do not depend on the unit of length.

    Attributes:
        means: [n, 3] mm, (x, y, z).
        log_scales: [n, 3], logarithms of standard deviations in mm along the Gaussian's own axes.
        quaternions: [n, 4] (w, x, y, z), rotations; their length need not be 1, but must not be 0.
        raw_densities: [n]; ρ = density_unit * softplus(raw), so a density is never negative.
        density_unit: a typical density in 1/mm, the unit of the densities.
        kernel: radial profile f.
    """

    means: Tensor
    log_scales: Tensor
    quaternions: Tensor
    raw_densities: Tensor
    density_unit: float = 1.0
    kernel: Kernel = Kernel.GAUSSIAN

    def __post_init__(self) -> None:
        check_settings(self)
        n = self.means.shape[0]
        for name, width in _PARAMETERS.items():
            expected = (n, *width)
            if (shape := tuple(getattr(self, name).shape)) != expected:
                raise ValueError(f"{name} has shape {shape}, expected {expected}")
        if not 0 < self.density_unit < float("inf"):
            raise ValueError(f"density_unit must be positive and finite, got {self.density_unit}")

    @classmethod
    def from_physical(
        cls,
        means: ArrayLike,
        scales: ArrayLike,
        densities: ArrayLike,
        quaternions: ArrayLike | None = None,
        density_unit: float | None = None,
        kernel: Kernel = Kernel.GAUSSIAN,
    ) -> Gaussians:
        """Gaussians at positions [n, 3] mm, with standard deviations [n, 3] or [n] mm and densities [n] 1/mm
        (positive).

        Raises:
            ValueError: a standard deviation or a density is not positive and finite.
        """
        check_arguments(cls.from_physical, locals())
        means = np.atleast_2d(np.asarray(means, np.float64))
        n = means.shape[0]
        if means.shape != (n, 3):
            raise ValueError(f"means must be positions [n, 3] in mm, got shape {means.shape}")
        scales = np.asarray(scales, np.float64)
        scales = np.broadcast_to(scales[:, None] if scales.ndim == 1 else scales, (n, 3))
        densities = np.broadcast_to(np.asarray(densities, np.float64), (n,))
        for name, values in (("scales", scales), ("densities", densities)):
            if not (np.isfinite(values).all() and (values > 0).all()):
                raise ValueError(
                    f"{name} must be positive and finite, got values from {values.min()} to {values.max()}"
                )
        unit = float(densities.max()) if density_unit is None else density_unit
        rotations = (
            np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)) if quaternions is None else np.asarray(quaternions, np.float64)
        )
        raw = inverse_softplus(densities / unit)
        return cls(_tensor(means), _tensor(np.log(scales)), _tensor(rotations), _tensor(raw), unit, kernel)

    @property
    def n(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Tensor:
        """Standard deviations [n, 3] in mm."""
        return self.log_scales.exp()

    @property
    def densities(self) -> Tensor:
        """ρ [n] in 1/mm."""
        from torch.nn.functional import softplus

        return self.density_unit * softplus(self.raw_densities)

    def select(self, index: Tensor) -> Gaussians:
        """The Gaussians at `index` (a mask or positions), as copies."""
        selected: dict[str, Any] = {name: getattr(self, name)[index] for name in _PARAMETERS}
        return replace(self, **selected)

    def widened(self, variance: float) -> Gaussians:
        """The same Gaussians, widened by adding `variance` (mm²) in every direction. Each Gaussian keeps its mass."""
        import torch

        if variance <= 0:
            return self
        wider = torch.sqrt(self.scales**2 + variance)
        density = (
            (self.densities * (self.scales / wider).prod(1) / self.density_unit).double().clamp(min=_FAINTEST_DENSITY)
        )
        raw = torch.from_numpy(inverse_softplus(density.detach().numpy())).to(self.raw_densities.dtype)
        return replace(self, log_scales=wider.log(), raw_densities=raw)

    def arrays(self) -> dict[str, NDArray[np.float32]]:
        """The raw parameters as numpy arrays by name."""
        return {name: getattr(self, name).detach().cpu().numpy() for name in _PARAMETERS}

    def physical(self) -> dict[str, NDArray[np.float32]]:
        """Centres [n, 3] (x, y, z) and widths [n, 3] in mm, unit quaternions [n, 4] (w, x, y, z), densities [n] 1/mm.

        `from_physical` is the inverse function.
        """
        from torch.nn.functional import normalize

        turned = normalize(self.quaternions, dim=1)
        values = {"centres": self.means, "widths": self.scales, "rotations": turned, "densities": self.densities}
        return {name: value.detach().cpu().numpy() for name, value in values.items()}


def turned_by_rows(gaussians: Gaussians, geometry: Geometry, sign: int) -> Gaussians:
    """The Gaussians, each rotated about the axis by the skew at its row. A Gaussian that extends over many rows is not
    bent.

    Args:
        sign: -1 rotates from the object's frame to the frame in which all rows have the angle of the first row; 1
            rotates back.
    """
    if not geometry.skew:
        return gaussians
    import torch

    rows = gaussians.means[:, 2] / geometry.pixel_pitch + geometry.axis_row
    angle = sign * geometry.skew * rows
    c, s = torch.cos(angle), torch.sin(angle)
    x, y, z = gaussians.means.unbind(1)
    a, b = torch.cos(angle / 2), torch.sin(angle / 2)
    qw, qx, qy, qz = gaussians.quaternions.unbind(1)
    return replace(
        gaussians,
        means=torch.stack((c * x - s * y, s * x + c * y, z), 1),
        quaternions=torch.stack((a * qw - b * qz, a * qx - b * qy, a * qy + b * qx, a * qz + b * qw), 1),
    )


def inverse_softplus(value: NDArray[np.floating]) -> NDArray[np.float64]:
    """x with log(1 + eˣ) = value, for value > 0: value + log(1 - e^-value), accurate for small and large values."""
    value = np.asarray(value, np.float64)
    return value + np.log(-np.expm1(-value))


def _tensor(values: NDArray[np.floating]) -> Tensor:
    torch = loaded("torch")
    try:
        tensor: Tensor = torch.from_numpy(np.ascontiguousarray(values, np.float32).copy())
    except RuntimeError as error:  # "Numpy is not available"
        raise LibraryError(
            "install torch and numpy versions that fit together: the installed torch was built for another version "
            f"of numpy ({error})",
            name="torch",
        ) from error
    return tensor


# share of the mass in needle-shaped Gaussians above which a warning is given, see docs/published.md
NEEDLES_LIMIT = 0.2

# standard deviation, in pixels, below which projections do not resolve a Gaussian; ratio of longest to shortest width
_THIN, _LONG = 0.5, 10.0


@dataclass(frozen=True)
class Needles:
    """Measure of needle-shaped Gaussians, which are thinner than the projections resolve.

    Attributes:
        thin: share of the mass in Gaussians that are narrower than half a pixel.
        share: share of the mass in needle-shaped Gaussians: narrower than half a pixel, and ten times as long as wide.
        aspect: median ratio of longest to shortest width, weighted by mass.
    """

    thin: float
    share: float
    aspect: float


def needles(gaussians: Gaussians, geometry: Geometry) -> Needles:
    """Measure how much of a model is in needle-shaped Gaussians. The mass of a Gaussian is its density times its three
    widths (standard deviations)."""
    values = gaussians.physical()
    widths = np.sort(values["widths"].astype(np.float64), axis=1)
    mass = values["densities"] * widths.prod(axis=1)
    mass = mass / max(float(mass.sum()), 1e-300)
    aspect = widths[:, 2] / widths[:, 0]
    thin = widths[:, 0] < _THIN * geometry.sample_pitch
    order = np.argsort(aspect)
    middle = min(int(np.searchsorted(np.cumsum(mass[order]), 0.5)), order.size - 1)
    return Needles(float(mass[thin].sum()), float(mass[thin & (aspect > _LONG)].sum()), float(aspect[order[middle]]))
