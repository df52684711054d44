"""Frames for the monitor's tests: analytic discs, photon noise, offset, and faults put in by hand."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from beamline.monitor import watch as scan
from beamline.monitor.check import Check, Flag, ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import digest
from drivers.base.frame import Frame, FrameKind

ROWS, COLS = 64, 96
OFFSET, PHOTONS = 200.0, 3000.0
PERIOD = 0.1
SATURATION = 65535
DISCS = ((0.0, 0.0, 30.0, 0.02), (10.0, 5.0, 8.0, 0.05), (-12.0, 3.0, 6.0, 0.05))  # x, y, radius in px, 1/px
STEP = np.pi / 180


class FakeScan:
    """Makes frames one after another in file order, with seeded noise."""

    def __init__(self) -> None:
        self.rng = np.random.default_rng(5)
        self.row = 0
        self.trigger = 0
        self.time = 1000.0

    def expected(self, angle: float | None, discs: Iterable[tuple[float, ...]] = DISCS) -> NDArray[np.float64]:
        """Expected photons [row, col] with the sample at `angle`; None: without sample."""
        depth = np.zeros(COLS)
        if angle is not None:
            for x, y, radius, attenuation in discs:
                u = np.arange(COLS) - (COLS - 1) / 2 - (x * np.cos(angle) + y * np.sin(angle))
                depth += 2 * attenuation * np.sqrt(np.clip(radius**2 - u**2, 0, None))
        return np.tile(PHOTONS * np.exp(-depth), (ROWS, 1))

    def frame(self, kind: FrameKind, photons: NDArray[np.float64], angle: float = np.nan) -> Frame:
        counts = OFFSET + self.rng.poisson(photons) * 4 + self.rng.normal(0, 4, photons.shape)
        frame = Frame(
            counts=np.rint(counts).clip(0, SATURATION).astype(np.uint16),
            kind=kind,
            index=self.row,
            trigger=self.trigger,
            framestamp=self.trigger,
            angle=angle,
            time=self.time,
            exposure=0.05,
        )
        self.row, self.trigger, self.time = self.row + 1, self.trigger + 1, self.time + PERIOD
        return frame

    def darks(self, n: int = 5, light: float = 0.0) -> list[Frame]:
        self.trigger = 0
        return [self.frame(FrameKind.DARK, light * self.expected(None)) for _ in range(n)]

    def flats(self, n: int = 5, light: float = 1.0) -> list[Frame]:
        self.trigger = 0
        return [self.frame(FrameKind.FLAT, light * self.expected(None)) for _ in range(n)]

    def views(
        self, n: int, first: int = 0, light: float = 1.0, discs: Iterable[tuple[float, ...]] = DISCS
    ) -> list[Frame]:
        self.trigger = first
        discs = tuple(discs)
        return [
            self.frame(FrameKind.PROJECTION, light * self.expected(i * STEP, discs), i * STEP)
            for i in range(first, first + n)
        ]

    def again(
        self, views: Iterable[int], first: int, light: float = 1.0, discs: Iterable[tuple[float, ...]] = DISCS
    ) -> list[Frame]:
        """Projections that are repeated after the last one; projection 0 is row `first`."""
        discs = tuple(discs)
        taken = [self.frame(FrameKind.PROJECTION, light * self.expected(i * STEP, discs), i * STEP) for i in views]
        return [replace(frame, replaces=first + i) for frame, i in zip(taken, views, strict=True)]

    def references(self) -> list[Frame]:
        return self.darks() + self.flats()

    def flags(
        self,
        frames: Iterable[Frame],
        period: float | None = PERIOD,
        checks: Sequence[Check] = CHECKS,
        stored: frozenset[int] = frozenset(),
        step: float = np.nan,
    ) -> list[Flag]:
        """All flags of a new monitor for `frames`."""
        context = ScanContext(saturation=SATURATION, pixels=ROWS * COLS, period=period, step=step, stored=stored)
        state = scan.start(context, checks)
        flags: list[Flag] = []
        for frame in frames:
            state, found = scan.look(state, frame, digest(frame.counts, SATURATION, 4))
            flags += found
        return flags

    def of(self, check: str, frames: Iterable[Frame], **options: Any) -> list[Flag]:
        """The flags of one check."""
        return [flag for flag in self.flags(frames, **options) if flag.check == check]


@pytest.fixture
def fake() -> FakeScan:
    return FakeScan()
