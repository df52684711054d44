"""SeveralScans: what a reconstruction asks of a source of views that is several scans of one sample."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from beamline.core.phases import Phases
from beamline.core.sinks import Warn
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.projections.view_geometry import stated_geometry
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from recon.base.method import Method


@runtime_checkable
class SeveralScans(Protocol):
    """A source of views, where `SourceOptions` is one of a single scan."""

    @property
    def scans(self) -> tuple[SourceOptions, ...]:
        """The facts of the first one are in the report."""

    @property
    def path(self) -> Path | str:
        """Of the first scan."""

    def open(self, *, follow: bool = False) -> ScanSource:
        """The first scan."""

    def refuse(self, method: Method, given: Collection[str]) -> None:
        """Raises ConfigError where the scans do not go with the method or the options of these names; opens none."""

    def require_alike(self, selection: Selection) -> None:
        """Raises ConfigError where the scans state what does not go together; reads no frame."""

    def prepare(
        self, selection: Selection, warn: Warn, check: Callable[[Geometry], object], phases: Phases | None
    ) -> PreparedProjections:
        """As `prepare_projections`, of all scans; `check` gets the geometry of each.

        Raises:
            ConfigError: scans that do not go together. DataError: a scan cannot be read.
        """


def scans_of(source: SourceOptions | SeveralScans) -> tuple[SourceOptions, ...]:
    """The scans, or the one that there is."""
    return source.scans if isinstance(source, SeveralScans) else (source,)


def views_of_others(source: SourceOptions | SeveralScans, selection: Selection) -> int:
    """Views of the scans after the first one, before any frame is read; 0 where there is one scan."""
    views = 0
    for each in scans_of(source)[1:]:
        with each.open() as scan:
            views += stated_geometry(scan, selection).n_views
    return views


def with_as_many_views(geometry: Geometry, views: int) -> Geometry:
    """So many views like these."""
    return geometry if views == geometry.n_views else geometry.select(np.resize(np.arange(geometry.n_views), views))
