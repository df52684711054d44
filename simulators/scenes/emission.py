"""Emission: counts of a sample that emits (PET), by its activity, its attenuation and a scanner's faults.

    mean = efficiency exp(-∫ μ) ∫ activity + scatter + randoms

Lines of response are binned as parallel views. Line integrals are those of solids, by formulas of their own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from simulators.frame.detector import Detector
from simulators.pixels.broad_blur import add_enlarged, broad_blur, gaussian
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder

F32 = NDArray[np.float32]
_RAYS = (-1 / 3, 0.0, 1 / 3)  # of a pixel, in pixels from its middle along a row


@dataclass(frozen=True)
class Rod:
    """A cylinder in the body. `activity`: over that of the body; `mu`: 1/mm at 511 keV; `at`: (x, y) in mm."""

    radius: float
    at: tuple[float, float]
    activity: float
    mu: float


WATER, AIR, TEFLON = 0.0096, 1e-5, 0.0174  # 1/mm at 511 keV: water 0.096 cm²/g, PTFE 0.079 cm²/g at 2.2 g/cm³


def _ring(radius: float, turn: int) -> tuple[float, float]:
    """A sixth of a turn from place to place."""
    return radius * math.cos(turn * math.pi / 3), radius * math.sin(turn * math.pi / 3)


@dataclass(frozen=True)
class NemaPhantom:
    """A cylinder of active water with hot rods of four times its activity, and cold ones of air and of Teflon.

    After the image-quality phantom of NEMA NU 4-2008, whose hot rods lie in cold plastic. Lengths in mm.
    """

    radius: float = 24.0
    height: float = 40.0
    rods: Mapping[str, Rod] = field(
        default_factory=lambda: {
            **{f"hot {2 * r:g} mm": Rod(r, _ring(13, k), 4.0, WATER) for k, r in enumerate((1.5, 2.5, 4.0, 5.5))},
            "air": Rod(5.5, _ring(13, 4), 0.0, AIR),
            "teflon": Rod(5.5, _ring(13, 5), 0.0, TEFLON),
        }
    )

    def _phantom(self, body: float, values: Sequence[float]) -> Phantom:
        """Solids add up: a rod has its value less that of the body."""
        rods = [
            Cylinder(rod.radius, self.height, value - body, (*rod.at, 0.0))
            for rod, value in zip(self.rods.values(), values, strict=True)
            if value != body
        ]
        return Phantom.of([Cylinder(self.radius, self.height, body), *rods])

    @property
    def activity(self) -> Phantom:
        """1 in the body."""
        return self._phantom(1.0, [rod.activity for rod in self.rods.values()])

    @property
    def mu(self) -> Phantom:
        """1/mm at 511 keV."""
        return self._phantom(WATER, [rod.mu for rod in self.rods.values()])


@dataclass(frozen=True)
class Scanner:
    """What a scanner adds to the counts of the activity.

    Attributes:
        trues: counts of pairs that arrive unscattered, of all lines together.
        scatter, randoms: their counts over the trues. Scatter is a broad blur of the trues, randoms are even.
        scatter_mm: standard deviation of that blur.
        spread: relative standard deviation of the efficiency from pixel to pixel.
    """

    trues: float = 1e6
    scatter: float = 0.15
    randoms: float = 0.2
    scatter_mm: float = 12.0
    spread: float = 0.1


@dataclass(frozen=True, eq=False)
class Events:
    """Counts and the means behind them, float32 [view, row, col].

    Attributes:
        counts: drawn from Poisson's law.
        efficiency: of the lines, 1 on average (normalisation).
        survival: efficiency x exp(-∫ μ).
        background: mean of scatter and randoms.
        scale: counts per mm of a line of activity 1.
    """

    counts: F32
    efficiency: F32
    survival: F32
    background: F32
    scale: float


def events(
    phantom: NemaPhantom, detector: Detector, angles: NDArray[np.float64], scanner: Scanner, seed: int
) -> Events:
    """Counts of the phantom in parallel views at `angles`, radians."""
    rng = np.random.default_rng(seed)
    lines, depth = (_line_integrals(sample, detector, angles) for sample in (phantom.activity, phantom.mu))
    efficiency = np.broadcast_to(rng.normal(1, scanner.spread, detector.shape).clip(0.3, 1.7), lines.shape)
    survival = efficiency * np.exp(-depth)
    trues = survival * lines
    scale = scanner.trues / float(trues.sum())
    trues *= scale
    background = efficiency * scanner.randoms * scanner.trues / trues.size
    for view, image in zip(background, trues, strict=True):
        add_enlarged(view, broad_blur(image, scanner.scatter_mm / detector.pitch, gaussian), scanner.scatter)
    counts = rng.poisson(trues + background).astype(np.float32)
    f32 = np.float32
    return Events(counts, efficiency.astype(f32), survival.astype(f32), background.astype(f32), scale)


def _line_integrals(sample: Phantom, detector: Detector, angles: NDArray[np.float64]) -> NDArray[np.float64]:
    """[view, row, col], mm x the sample's values: means over the rays of a pixel."""
    aimed = [detector.aimed(0.0, col) for col in _RAYS]
    return np.stack([np.mean([sample.line_integrals(a, rays) for rays in aimed], axis=0) for a in angles])
