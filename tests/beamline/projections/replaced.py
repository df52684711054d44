"""A scan of three balls with photon noise whose frames can be replaced, and the quality of its volume."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.projections.selection import Selection
from drivers.base.frame import FrameKind
from recon.voxels.fbp import fbp
from tests.beamline.array_source import ArraySource
from tests.beamline.prepared_views import prepare

SHAPE, VIEWS, AXIS = (12, 48), 45, 23.5
DARK, BEAM, READOUT = 100.0, 30_000.0, 2.0  # counts
# x, y, z, radius in pixels, and attenuation per pixel; the other balls are inside the first and add to it.
BALLS = ((2.0, 1.0, 0.0, 14.0, 0.02), (8.0, 3.0, 0.0, 4.0, 0.04), (-4.0, -5.0, 1.0, 4.0, 0.03))
ANGLES = np.linspace(0, np.pi, VIEWS, endpoint=False)

Frames = NDArray[np.float64]


def line_integrals(scale: float = 1.0) -> Frames:
    """[view, row, col], for rays through the centres of the pixels."""
    u, v = np.arange(SHAPE[1]) - AXIS, (np.arange(SHAPE[0]) - (SHAPE[0] - 1) / 2)[:, None]
    total = np.zeros((VIEWS, *SHAPE))
    for x, y, z, radius, mu in BALLS:
        at = (x * np.cos(ANGLES) + y * np.sin(ANGLES))[:, None, None]
        total += 2 * scale * mu * np.sqrt(np.clip(radius**2 - (u - at) ** 2 - (v - z) ** 2, 0, None))
    return total


def truth(scale: float = 1.0) -> Frames:
    """Attenuation [z, y, x] per pixel, averaged over voxels."""
    fine = [(np.arange(3 * n) + 0.5) / 3 - n / 2 for n in (SHAPE[0], SHAPE[1], SHAPE[1])]
    z, y, x = np.meshgrid(*fine, indexing="ij", sparse=True)
    total = sum(scale * mu * ((x - a) ** 2 + (y - b) ** 2 + (z - c) ** 2 <= r * r) for a, b, c, r, mu in BALLS)
    return np.asarray(total).reshape(SHAPE[0], 3, SHAPE[1], 3, SHAPE[1], 3).mean(axis=(1, 3, 5))


@dataclass
class Blocks:
    """The frames of a scan in groups, in file order; `groups` of darks and flats with `n` frames each."""

    groups: int = 2
    n: int = 3
    scale: float = 1.0
    seed: int = 0
    frames: list[tuple[FrameKind, Frames]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng, open_beam = np.random.default_rng(self.seed), np.zeros((self.n, *SHAPE))
        parts = np.array_split(line_integrals(self.scale), max(self.groups - 1, 1))
        for group in range(max(self.groups, len(parts))):
            if group < self.groups:
                self.frames += [(FrameKind.DARK, self.taken(open_beam, 0.0)), (FrameKind.FLAT, self.taken(open_beam))]
            if group < len(parts):
                self.frames.append((FrameKind.PROJECTION, self.taken(parts[group])))

    def taken(self, lines: Frames, light: float = BEAM) -> Frames:
        """Frames for these line integrals, each with independent noise."""
        noise = self.rng.normal(DARK, READOUT, lines.shape)
        return np.asarray((self.rng.poisson(light * np.exp(-lines)) + noise).round())

    def of(self, kind: FrameKind) -> list[Frames]:
        """The groups of frames of this kind, which may be changed."""
        return [frames for own, frames in self.frames if own is kind]

    def source(self) -> ArraySource:
        keys = [int(kind) for kind, frames in self.frames for _ in frames]
        angles = np.full(len(keys), np.nan)
        angles[np.array(keys) == FrameKind.PROJECTION] = ANGLES
        data = np.concatenate([frames for _, frames in self.frames])
        return ArraySource(data if np.isnan(data).any() else data.clip(0, 65535).astype(np.uint16), keys, angles)


def decibels(source: ArraySource, scale: float = 1.0) -> tuple[float, list[str]]:
    """PSNR of the FBP volume as a reconstruction makes it, and the messages."""
    found, told = prepare(source, Selection(axis_col=AXIS))
    right, made = truth(scale), fbp(found.seen.data, found.geometry, filter="hann")
    return float(20 * np.log10(right.max() / np.sqrt(np.mean((made - right) ** 2)))), told
