"""Light: beams and their energies, and materials whose attenuation depends on the energy."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated

from recon.base.setting import Setting, setting
from simulators.frame.mapping import NotNegative, Positive

# mm, limits of the distances of the source of a cone: squares of much larger distances overflow
NEAREST, FARTHEST = 1e-6, 1e9


@dataclass(frozen=True)
class Tube:
    """An X-ray tube: the bremsstrahlung of a thick target behind filters, with (kv - E) / E photons per energy interval
    at E (Kramers, Phil. Mag. 46, 836, 1923). Characteristic lines are not included; to include them, give the spectrum
    as a table.

    Attributes:
        kv: the voltage in kV, which is also the highest energy in keV.
        filters: thickness in mm of each filter in the beam, such as {Al: 1.0, Cu: 0.1}.
    """

    kv: Annotated[float, Setting(ge=5, le=800)]
    filters: Mapping[str, NotNegative] | None = None


@dataclass(frozen=True)
class Beam:
    """A parallel beam, or a cone beam if the distances are given.

    The energies affect materials only: a grey solid attenuates all energies equally. Weights are shares of the photons
    detected in the open beam, so that `photons_per_s` has the same meaning for any spectrum. The response of the
    detector to each energy is part of the weights.

    Attributes:
        photons_per_s: number of photons that each (unbinned) sensor pixel detects per second in the open beam.
        sod: mm from the source to the rotation axis; None for a parallel beam.
        sdd: mm from the source to the detector.
        energy_kev: energy of a monochromatic beam, or the middle of its bandwidth. bandwidth: full width at half
            maximum of a Gaussian line, divided by the energy: 1e-4 behind Si 111, 0.01 to 0.05 for pink beams. None: a
            single energy.
        harmonics: shares of the light at multiples of the energy: {3: 0.01}. None: no harmonics.
        spectrum: [keV, weight] pairs with any sum of weights; it replaces energy_kev. tube: an X-ray tube; it replaces
            energy_kev.
    """

    photons_per_s: NotNegative
    sod: float | None = None
    sdd: float | None = None
    energy_kev: Positive | None = None
    bandwidth: float | None = setting(None, gt=0, le=0.2)
    harmonics: Mapping[Annotated[int, Setting(ge=2)], NotNegative] | None = None
    spectrum: tuple[tuple[Positive, NotNegative], ...] | None = None
    tube: Tube | None = None

    def __post_init__(self) -> None:
        if (self.sod is None) != (self.sdd is None):
            raise ValueError("a cone needs both sod and sdd in mm; a parallel beam neither")
        if self.sod is not None and self.sdd is not None and not self.sdd >= self.sod > 0:
            raise ValueError(f"sod must be positive and sdd no less, got {self.sod} and {self.sdd} mm")
        if self.sod is not None and self.sdd is not None and not NEAREST <= self.sod <= self.sdd <= FARTHEST:
            raise ValueError(
                f"sod and sdd must be {NEAREST:g} ... {FARTHEST:g} mm, got {self.sod} and {self.sdd}. A "
                "beam from farther away is parallel: omit both"
            )
        given = [name for name in ("energy_kev", "spectrum", "tube") if getattr(self, name) is not None]
        if len(given) > 1:
            raise ValueError(f"{' and '.join(given)} exclude each other; give one of them")
        for name in ("bandwidth", "harmonics"):
            if getattr(self, name) is not None and self.energy_kev is None:
                raise ValueError(f"{name} needs an energy_kev, which is missing")
        shares = self.harmonics or {}
        if sum(shares.values()) >= 1:
            raise ValueError(f"harmonics are shares, below 1 in sum, got {dict(shares)}")
        if self.spectrum is not None and not sum(weight for _, weight in self.spectrum) > 0:
            raise ValueError(f"spectrum is a list of [keV, weight], not all of weight 0, got {self.spectrum}")

    @property
    def source_distance(self) -> float:
        """mm from the source to the rotation axis; infinite for a parallel beam."""
        return math.inf if self.sod is None else self.sod

    @property
    def has_energy(self) -> bool:
        """True if the beam has energies; materials need them."""
        return any(light is not None for light in (self.energy_kev, self.spectrum, self.tube))
