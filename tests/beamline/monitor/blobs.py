"""A rotating sample of Gaussian blobs, as previews of 32 x 128 blocks: fast enough for hundreds of projections."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.monitor import watch
from beamline.monitor.check import Check, Flag, ScanContext
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import FrameDigest
from drivers.base.frame import Frame, FrameKind

ROWS, COLS, BLOCK = 32, 128, 4
OPEN, DARK, NOISE = 20_000.0, 100.0, 0.004  # counts, counts, relative noise of a block in the open beam
STEP = np.radians(0.2)

Change = Callable[[int, NDArray[np.float64]], NDArray[np.float64]]
"""Function that changes the line integrals, or the counts, of projection i."""


def unchanged(view: int, image: NDArray[np.float64]) -> NDArray[np.float64]:
    return image


class Blobs:
    """A scan of `views` projections; `depth` changes line integrals, `counts` changes counts.

    The file begins with 5 darks and 5 flats, so projection i is row 10 + i.
    """

    def __init__(
        self, views: int = 90, depth: Change = unchanged, counts: Change = unchanged, step: float = STEP, seed: int = 3
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.views, self.depth, self.counts, self.step = views, depth, counts, step
        blobs = 60
        radius = 52 * np.sqrt(self.rng.uniform(0, 1, blobs))
        self.at = radius, self.rng.uniform(0, 2 * np.pi, blobs)
        self.rows, self.sizes = self.rng.uniform(0, ROWS, blobs), self.rng.uniform(1.5, 5, blobs)
        self.depths = self.rng.uniform(0.05, 0.3, blobs)

    def line_integrals(self, view: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
        """[row, col] with the sample shifted by (down, across) blocks; `view` need not be an integer."""
        radius, phase = self.at
        cols = (COLS - 1) / 2 + radius * np.cos(view * self.step + phase) + shift[1]
        down = np.exp(-0.5 * ((np.arange(ROWS)[:, None] - self.rows - shift[0]) / self.sizes) ** 2)
        across = np.exp(-0.5 * ((np.arange(COLS)[:, None] - cols) / self.sizes) ** 2)
        return (down * self.depths) @ across.T

    def frames(self) -> Sequence[tuple[Frame, FrameDigest]]:
        frames = [self._frame(FrameKind.DARK, i, np.zeros((ROWS, COLS))) for i in range(5)]
        frames += [self._frame(FrameKind.FLAT, 5 + i, np.full((ROWS, COLS), OPEN)) for i in range(5)]
        for view in range(self.views):
            light = OPEN * np.exp(-self.depth(view, self.line_integrals(view)))
            frames.append(self._frame(FrameKind.PROJECTION, 10 + view, self.counts(view, light), view * self.step))
        return frames

    def _frame(
        self, kind: FrameKind, row: int, light: NDArray[np.float64], angle: float = np.nan
    ) -> tuple[Frame, FrameDigest]:
        noise = self.rng.normal(size=light.shape) * NOISE * np.sqrt(OPEN * np.maximum(light, 1.0))
        preview = (DARK + light + noise).astype(np.float32)
        counts = np.broadcast_to(np.uint16(0), (ROWS * BLOCK, COLS * BLOCK))
        frame = Frame(counts, kind, row, max(row - 10, 0), row, angle, row * 0.1, 0.05)
        mean = float(preview.mean())
        return frame, FrameDigest(0.0, 65535.0, mean, 1.0, mean, 0.0, 0.0, 1.0, row, preview, preview)

    def flags(self, checks: Sequence[Check] = CHECKS, **known: Any) -> list[Flag]:
        """The flags of the checks. `known`: further values of the scan for the checks, see ScanContext."""
        monitor = watch.start(ScanContext(65535, ROWS * COLS * BLOCK**2, 0.1, **known), checks)
        found: list[Flag] = []
        for frame, digest in self.frames():
            monitor, flags = watch.look(monitor, frame, digest)
            found += flags
        return found


def blob(row: float, col: float, size: float, depth: float) -> NDArray[np.float64]:
    """Line integrals [row, col] of a round cloud."""
    down, across = (np.exp(-0.5 * ((np.arange(n) - at) / size) ** 2) for n, at in ((ROWS, row), (COLS, col)))
    return depth * down[:, None] * across
