"""Emission: counts of a sample that emits (PET), by its activity, its attenuation and a scanner's faults.

    emission: {radius: 24.0, height: 40.0}          # mm; rods: {NAME: {radius, at, activity, mu}} instead of its own
    scanner: {trues: 1.5e7, scatter: 0.15, randoms: 0.2}
    lines: {views: 120, shape: [16, 64], pitch: 1.0}

    mean = efficiency exp(-∫ μ) ∫ activity + scatter + randoms

Lines of response are binned as parallel views. Line integrals are those of solids, by formulas of their own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from simulators.frame.mapping import BelowOne, NotNegative, Positive, build
from simulators.frame.shot import Detector
from simulators.pixels.broad_blur import add_enlarged, broad_blur, gaussian
from simulators.samples.bodies.phantom import Phantom
from simulators.samples.bodies.solids import Cylinder

F32 = NDArray[np.float32]
_RAYS = (-1 / 3, 0.0, 1 / 3)  # of a pixel, in pixels from its middle along a row


@dataclass(frozen=True)
class Rod:
    """A cylinder in the body. `activity`: over that of the body; `mu`: 1/mm at 511 keV; `at`: (x, y) in mm."""

    radius: Positive
    at: tuple[float, float]
    activity: NotNegative
    mu: NotNegative


WATER, AIR, TEFLON = 0.0096, 1e-5, 0.0174  # 1/mm at 511 keV: water 0.096 cm²/g, PTFE 0.079 cm²/g at 2.2 g/cm³


def _ring(radius: float, turn: int) -> tuple[float, float]:
    """A sixth of a turn from place to place."""
    return radius * math.cos(turn * math.pi / 3), radius * math.sin(turn * math.pi / 3)


@dataclass(frozen=True)
class NemaPhantom:
    """A cylinder of active water with hot rods of four times its activity, and cold ones of air and of Teflon.

    After the image-quality phantom of NEMA NU 4-2008, whose hot rods lie in cold plastic. Lengths in mm.
    """

    radius: Positive = 24.0
    height: Positive = 40.0
    rods: Mapping[str, Rod] = field(
        default_factory=lambda: {
            **{f"hot {2 * r:g} mm": Rod(r, _ring(13, k), 4.0, WATER) for k, r in enumerate((1.5, 2.5, 4.0, 5.5))},
            "air": Rod(5.5, _ring(13, 4), 0.0, AIR),
            "teflon": Rod(5.5, _ring(13, 5), 0.0, TEFLON),
        }
    )

    def __post_init__(self) -> None:
        rods = list(self.rods.items())
        for n, (name, rod) in enumerate(rods):
            if math.hypot(*rod.at) + rod.radius > self.radius:
                raise ValueError(f"rod {name!r} leaves the body of radius {self.radius:g} mm; place it inside")
            for other, near in rods[:n]:
                if math.dist(rod.at, near.at) < rod.radius + near.radius:
                    raise ValueError(f"rods {other!r} and {name!r} overlap; place them apart")

    def _phantom(self, body: float, values: Sequence[float]) -> Phantom:
        """Solids add up: a rod has its value less that of the body."""
        rods = {
            name: Cylinder(rod.radius, self.height, value - body, (*rod.at, 0.0))
            for (name, rod), value in zip(self.rods.items(), values, strict=True)
            if value != body
        }
        return Phantom.of([Cylinder(self.radius, self.height, body), *rods.values()], ["body", *rods])

    @property
    def activity(self) -> Phantom:
        """Relative activity: 1 in the body."""
        return self._phantom(1.0, [rod.activity for rod in self.rods.values()])

    @property
    def mu(self) -> Phantom:
        """Attenuation in 1/mm at 511 keV."""
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

    trues: Positive = 1e6
    scatter: NotNegative = 0.15
    randoms: NotNegative = 0.2
    scatter_mm: Positive = 12.0
    spread: BelowOne = 0.1


@dataclass(frozen=True)
class Lines:
    """Lines of response in parallel views over half a turn. `shape`: (rows, cols); `pitch`: mm from line to line."""

    views: Annotated[int, Field(ge=2, le=100_000)] = 120
    shape: tuple[Annotated[int, Field(ge=1)], Annotated[int, Field(ge=2)]] = (16, 64)
    pitch: Positive = 1.0

    @property
    def detector(self) -> Detector:
        return Detector.centred(self.shape, self.pitch)

    @property
    def angles(self) -> NDArray[np.float64]:
        """Angles [view] in radians."""
        return np.linspace(0, math.pi, self.views, endpoint=False)


@dataclass(frozen=True)
class EmissionScene:
    """The keys of a scene of an emission."""

    emission: NemaPhantom
    scanner: Scanner = field(default_factory=Scanner)
    lines: Lines = field(default_factory=Lines)


def load_emission(mapping: Mapping[str, Any]) -> EmissionScene:
    """The scene of a mapping of YAML. Raises SceneError: an unknown key or a wrong value."""
    return build(EmissionScene, "scene", mapping)


@dataclass(frozen=True, eq=False)
class Events:
    """Counts and the means behind them, float32 [view, row, col].

    Attributes:
        counts: drawn from Poisson's law.
        efficiency: of the lines, 1 on average (normalisation).
        attenuation: ∫ μ.
        scatter, randoms: their means.
        scale: counts per mm of a line of activity 1.
    """

    counts: F32
    efficiency: F32
    attenuation: F32
    scatter: F32
    randoms: F32
    scale: float

    @property
    def survival(self) -> F32:
        return self.efficiency * np.exp(-self.attenuation)

    @property
    def background(self) -> F32:
        return self.scatter + self.randoms


def events(
    phantom: NemaPhantom,
    detector: Detector,
    angles: NDArray[np.float64],
    scanner: Scanner,
    seed: int,
    progress: Callable[[int, int], object] = lambda n, of: None,
) -> Events:
    """Counts of the phantom in parallel views at `angles`, radians. `progress` hears how many views are done."""
    rng = np.random.default_rng(seed)
    aimed, samples = [detector.aimed(0.0, col) for col in _RAYS], (phantom.activity, phantom.mu)
    lines, depth = np.empty((2, angles.size, *detector.shape))
    for n, angle in enumerate(angles):  # means over the rays of a pixel
        lines[n], depth[n] = (np.mean([one.line_integrals(angle, rays) for rays in aimed], axis=0) for one in samples)
        progress(n + 1, angles.size)
    efficiency = np.broadcast_to(rng.normal(1, scanner.spread, detector.shape).clip(0.3, 1.7), lines.shape)
    survival = efficiency * np.exp(-depth)
    trues = survival * lines
    scale = scanner.trues / float(trues.sum())
    trues *= scale
    randoms, scatter = efficiency * scanner.randoms * scanner.trues / trues.size, np.zeros_like(trues)
    for view, image in zip(scatter, trues, strict=True):
        add_enlarged(view, broad_blur(image, scanner.scatter_mm / detector.pitch, gaussian), scanner.scatter)
    counts = rng.poisson(trues + randoms + scatter)
    f32 = np.float32
    kept = efficiency.astype(f32), depth.astype(f32), scatter.astype(f32), randoms.astype(f32)
    return Events(counts.astype(f32), *kept, scale)
