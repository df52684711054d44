"""Field: parts of the frame without light, and a sample beyond its edges."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np
import pydantic
from numpy.typing import NDArray

from beamline.monitor.check import Flag, Level, Look, Policy, ScanContext, at_edges
from beamline.monitor.digest import FrameDigest
from beamline.monitor.view import BRIGHT, UNLIT, CellGrid
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import median_deviation
from recon.voxels.field_edges import LEAST

LASTS = 5  # views in a row with matter at an edge
NO_BEAM = 3.0  # times the noise: a flat's bright part below this has no light; noise alone gives 1.3
NAMED = 4  # most shadows that are named


@dataclass(frozen=True)
class FieldState:
    """Unlit flats were reported; a view had all matter inside; views in a row with matter at the edges; that was
    reported."""

    unlit: bool = False
    inside: bool = False
    cut: int = 0
    reported: bool = False


@dataclass(frozen=True)
class FieldOfViewCheck:
    """Score: share of the frame without light (a flat), or line integral at the field's edge (an info, once a scan).

    The defaults: a line integral of 0.1 at the edges is a tenth of the value in a sample's middle. It is more than
    phase fringes and scattered light leave there. Slits usually shadow a line or two at the frame's edges.
    """

    name: ClassVar[str] = "field"
    bit: ClassVar[int] = 13
    unit: ClassVar[str] = "share of the frame, or line integral at its edge"
    meaning: ClassVar[str] = "a part of the frame gets no light even without a sample"
    policy: ClassVar[Policy] = Policy.LOG

    unlit: Annotated[float, pydantic.Field(ge=0, lt=1, description="share of the frame that may be without light")] = (
        0.02
    )
    edge: Annotated[
        float, pydantic.Field(ge=0, description="line integral at the edges up to which the sample is inside")
    ] = LEAST

    start = FieldState

    def look(self, state: FieldState, frame: Frame, digest: FrameDigest, context: ScanContext) -> Look[FieldState]:
        if frame.kind is FrameKind.FLAT and context.dark is not None:
            if state.unlit:
                return Look(state)
            flag = self._unlit(frame, digest.preview - context.dark)
            return Look(replace(state, unlit=flag is not None), flag)
        if context.view is None or context.grid is None or not context.grid.flats or state.reported:
            return Look(state)
        edges = at_edges(context)
        cut = state.cut + 1 if max(edges) > self.edge else 0
        if cut < LASTS:
            return Look(replace(state, cut=cut, inside=state.inside or cut == 0))
        return Look(replace(state, reported=True), self._cut(frame.index, edges, context.grid, state.inside))

    def _unlit(self, frame: Frame, light: NDArray[np.float32]) -> Flag | None:
        bright = float(np.percentile(light[::2, ::2], BRIGHT))
        rows, cols = frame.counts.shape
        if bright <= NO_BEAM * _noise(light):
            advice = "No part of this flat has light that the darks have not: is the beam on, and the shutter open?"
            return Flag(self.name, Level.WARN, frame.index, 1.0, self.unlit, advice, (0, rows, 0, cols))
        unlit = light < UNLIT * bright
        share = float(unlit.mean())
        if share <= self.unlit:
            return None
        step = frame.counts.shape[0] / light.shape[0]
        strips = [
            (first, after, axis) for axis in (0, 1) for first, after in _runs(unlit.mean(axis=1 - axis) > 0.5, step)
        ]
        names = [f"{('rows', 'columns')[axis]} {first} ... {after - 1}" for first, after, axis in strips]
        named = ", ".join(names[:NAMED])
        named += f", and {len(strips) - NAMED} more" if len(strips) > NAMED else ""
        first, after, axis = max(strips, key=lambda strip: strip[1] - strip[0], default=(0, rows, 0))
        region = (first, min(after, rows), 0, cols) if axis == 0 else (0, rows, first, min(after, cols))
        advice = (
            f"{share:.0%} of the frame gets no light, without a sample ({named or 'here and there'}): a slit or an "
            "aperture shadows it. Open it, or choose a smaller region of the camera."
        )
        return Flag(self.name, Level.WARN, frame.index, share, self.unlit, advice, region)

    def _cut(self, row: int, edges: tuple[float, float], grid: CellGrid, entered: bool) -> Flag:
        left, right = edges
        cut = {side: depth for side, depth in (("left", left), ("right", right)) if depth > self.edge}
        beside = " It was inside before, so that it stands beside the rotation axis: centre it." * (
            entered and len(cut) == 1
        )
        advice = (
            f"{beyond_the_field(cut)}{beside} The total absorption says nothing, floaters must be faster to be seen, "
            "and reconstructions are brighter at the rim."
        )
        rows, last = grid.shape[0] * grid.cell, grid.right + 1
        first = grid.left if left >= right else max(last - 2, 0)
        region = (0, rows, first * grid.cell, (first + 2) * grid.cell)
        return Flag(self.name, Level.INFO, row, max(left, right), self.edge, advice, region)


def beyond_the_field(cut: Mapping[str, float]) -> str:
    """A sentence for edges ("left", "right") that the sample goes on beyond, by the line integrals there."""
    return (
        f"The sample goes on beyond the {' and '.join(cut)} edge of the field (line integral {max(cut.values()):.2f} "
        "there)."
    )


def _noise(light: NDArray[np.float32]) -> float:
    """Standard deviation of a block, from the differences of neighbours in a row: the beam's shape is smooth."""
    return median_deviation(np.diff(light[::2], axis=1)) / math.sqrt(2.0)


def _runs(marked: NDArray[np.bool_], step: float) -> list[tuple[int, int]]:
    """First pixel, and the one after the last, of each unbroken run of marked lines of the preview."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], marked, [False]]).astype(np.int8)))
    return [(round(first * step), round(after * step)) for first, after in edges.reshape(-1, 2).tolist()]
