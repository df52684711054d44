"""Filters of views: what the steps on views do to a batch, and the rows around it that they need."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beamline.core.errors import ConfigError
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.protocols import ViewFilter, ViewStep
from beamline.projections.registry import in_order
from beamline.projections.selection import Selection, rows_of
from beamline.projections.step import StepDone
from beamline.storage.readers.base import ScanSource
from recon.prep.correct import Projections


@dataclass(frozen=True, eq=False)
class ViewFilters:
    """The filters of one scan, one after the other.

    Attributes:
        filters: in their order.
        done: what each step on views does, by name.
        rows: detector rows that are wanted, whole bins.
        binning: pixels averaged per side.
        height: rows of the detector.
    """

    filters: tuple[ViewFilter, ...]
    done: dict[str, StepDone]
    rows: slice
    binning: int
    height: int

    @classmethod
    def of(cls, source: ScanSource, selection: Selection) -> ViewFilters:
        """The filters of a selection.

        Raises:
            ConfigError: rows or binning that do not fit the detector, or filters of counted photons.
        """
        rows = rows_of(source, selection)
        outcomes = {step.name: step.on(source, selection) for step in in_order(selection) if isinstance(step, ViewStep)}
        filters = tuple(each for each, _ in outcomes.values() if each is not None)
        if filters and selection.step(Preparation).noise == "counts":
            raise ConfigError(
                f"{filters[-1].mixes} neighbouring pixels, so that --noise counts has no likelihood for them."
            )
        done = {name: each for name, (_, each) in outcomes.items()}
        return cls(filters, done, rows, selection.binning, source.shape[0])

    def read(self, rows: slice | None) -> slice:
        """Detector rows to read for some binned rows (None: all), with the rows around that filters need."""
        return self._widened(rows)[0]

    def within(self, rows: slice | None) -> slice:
        """The same, binned, as a part of what is read for all rows."""
        first, part = self.read(None).start, self.read(rows)
        return slice((part.start - first) // self.binning, (part.stop - first) // self.binning)

    def apply(self, views: Projections, rows: slice | None) -> Projections:
        """The views through all filters, in the rows that are wanted."""
        if not self.filters or not views.view_ids.size:
            return views
        read, kept = self._widened(rows)
        for each in self.filters:
            views = each.apply(views, read.start)
        return replace(views, data=np.ascontiguousarray(views.data[:, kept]), masked=views.masked[kept])

    def _widened(self, rows: slice | None) -> tuple[slice, slice]:
        """Detector rows to read, and which of them are wanted, in binned rows."""
        n, reach = self.binning, sum(each.reach for each in self.filters)
        first, end = self.rows.start, self.rows.stop
        if rows is not None:
            start, stop, _ = rows.indices((end - first) // n)
            first, end = first + start * n, first + stop * n
        above = min(reach, first // n)
        below = min(reach, (self.height - end) // n)
        return slice(first - above * n, end + below * n), slice(above, above + (end - first) // n)
