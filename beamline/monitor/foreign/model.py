"""Model: differences of a view from a reconstruction of the scan.

The view's line integrals less those of a volume, in units of the view's noise. Their common part (light) is
removed, and they are averaged over 3 x 3 cells. A volume never fits its views fully: at each place the difference is
divided by the usual one there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import pydantic
import scipy

from beamline.monitor.check import Flag, Level, Logged, Look, ScanContext
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import CellValues, cell_noise
from drivers.base.frame import Frame

BROAD = 3  # cells a side, over which a difference is averaged
CALIBRATION = 10  # views
MEMORY = 0.1  # weight of the newest view in a place's usual difference
OUTLIER = 3.0  # times the usual difference, which a single view may add
EXTENT = 0.5  # of the limit, above which a cell belongs to the region


@dataclass(frozen=True, eq=False)
class ModelState:
    """Number of views so far, and the usual squared difference of each cell; None before the first view."""

    views: int = 0
    usual: CellValues | None = None


@dataclass(frozen=True)
class ModelCheck(Logged):
    """Score: largest difference from the volume, in standard deviations of the usual difference at its place.

    The default: a frame has up to 18,000 cells; noise takes one of them beyond 5 standard deviations in 100 views.
    Edges that the volume blurs move from cell to cell and have longer tails.
    """

    name: ClassVar[str] = "model"
    bit: ClassVar[int] = 33
    unit: ClassVar[str] = "standard deviations"
    meaning: ClassVar[str] = "a part of the view differs from the render of the reconstruction that was given"

    warn: Annotated[float, pydantic.Field(ge=0, description="standard deviations by which a part may differ")] = 6.0

    start = ModelState

    def look(self, state: ModelState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[ModelState]:
        view, grid = context.view, context.grid
        if context.model is None or view is None or grid is None or not grid.flats:
            return Look(state)
        expected = context.model(view.angle, grid.cell)
        rows, cols = (min(pair) for pair in zip(expected.shape, view.depth.shape, strict=True))
        depth, weight = view.depth[:rows, :cols], view.weight[:rows, :cols]
        noise = cell_noise(depth, weight)
        lit = weight > 0
        if not lit.any() or not noise > 0:
            return Look(state)
        left = depth - expected[:rows, :cols]
        left = np.where(lit, (left - np.float32(np.median(left[lit]))) * np.sqrt(weight), 0) / np.float32(noise)
        z = scipy.ndimage.uniform_filter(left, BROAD) * BROAD
        usual = np.maximum(z**2, 1) if state.usual is None else state.usual
        most = OUTLIER**2 * usual
        after = ModelState(state.views + 1, usual + np.float32(MEMORY) * (np.minimum(z**2, most) - usual))
        if state.views < CALIBRATION:
            return Look(after)
        score = z / np.sqrt(np.maximum(scipy.ndimage.uniform_filter(usual, BROAD), 1))
        worst = np.unravel_index(np.abs(score).argmax(), score.shape)
        peak = float(score[worst])
        if abs(peak) <= self.warn:
            return Look(after)
        parts, _ = scipy.ndimage.label(score * math.copysign(1, peak) > EXTENT * self.warn)
        there = np.nonzero(parts == parts[worst])
        top, below, first, last = (int(x) for x in (there[0].min(), there[0].max(), there[1].min(), there[1].max()))
        region = top * grid.cell, (below + 1) * grid.cell, first * grid.cell, (last + 1) * grid.cell
        advice = (
            f"Rows {region[0]} ... {region[1] - 1}, columns {region[2]} ... {region[3] - 1} absorb "
            f"{'more' if peak > 0 else 'less'} than the volume says, by {abs(peak):.0f} times what is usual there: the "
            "sample differed in this view, or something was in the beam."
        )
        return Look(after, Flag(self.name, Level.WARN, frame.index, peak, self.warn, advice, region))
