"""States of the live fit, which reconstructs a volume from the frames of a running scan.

```
WaitsForReferences --darks and flats can be used--> WaitsForAxis --its column is known--> Feeds --end--> LastFit
```

The functions of `live_steps` lead from one state to the next. After each reading of the file, they go as far as
possible: with the first projection the fit may pass two states and take a batch. If the axis is known, the fit does not
wait for it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Sink, StateEntered
from beamline.core.sinks import Warnings
from beamline.projections.growing import FedCorrection
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import ScanSelection, SelectedScan
from beamline.projections.step import StepDone
from beamline.reconstruct.followed_views import AxisSearch, FollowedViews
from beamline.reconstruct.job import corrections_done
from beamline.storage.readers.base import ScanSource
from drivers.base.clock import Clock
from recon.base.method import Progress
from recon.prep.projections import Projections
from recon.splatting.fit_method import Fit
from recon.splatting.stream import StreamingFit


@dataclass(frozen=True, eq=False)
class LiveScan:
    """A running scan, and how its volume is made. The object does not change; only the file of `views` grows.

    Attributes:
        begin: time at which the live fit began to wait for projections.
    """

    method: Fit
    seed: int
    views: FollowedViews
    sink: Sink
    clock: Clock
    warn: Warnings
    begin: float

    @property
    def source(self) -> ScanSource:
        return self.views.source

    @property
    def selection(self) -> ScanSelection:
        return self.views.scan.selection

    def enter(self, state: str, message: str) -> None:
        """Report what the live fit does now, and why."""
        self.sink(StateEntered(state, message, time=self.clock.now()))

    def tell_done(self, done: Mapping[str, StepDone]) -> None:
        """Report what correction steps did."""
        corrections_done({name: each.sentence for name, each in done.items()}, self.sink, self.clock)


@dataclass(frozen=True, eq=False)
class Cursor:
    """How many frames a growing file has, and how many of them the fit has used.

    Attributes:
        frames: number of frames in the file when it was last read.
        views: rows of the projections in the file that may be used.
        ended: the scan has ended, so that no frame comes after these.
        taken: number of frames that were corrected or are not projections.
    """

    frames: int = 0
    views: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))
    ended: bool = False
    taken: int = 0

    @property
    def behind(self) -> bool:
        """Whether the file has frames that the fit has not read yet."""
        return self.taken < self.frames

    @property
    def new(self) -> NDArray[np.int64]:
        """Rows of the projections that were not corrected yet."""
        return self.views[self.views >= self.taken]


@dataclass(frozen=True, eq=False)
class WaitsForReferences:
    """The correction cannot begin: no projection is there, or darks or flats are missing.

    Attributes:
        scan: the scan as it was when the file was last read.
        axis_col: the stated rotation axis in pixels of the file; None: the axis must be found.
        come_last: darks or flats come after the projections, so the fit waits for the end of the scan; this was
            reported.
    """

    scan: SelectedScan
    axis_col: float | None
    come_last: bool = False


@dataclass(frozen=True, eq=False)
class WaitsForAxis:
    """Projections can be corrected, but they do not show the rotation axis yet.

    Attributes:
        correction: the correction with the references known so far; it has not corrected any projection yet.
        search: the search so far.
    """

    correction: FedCorrection
    search: AxisSearch


@dataclass(frozen=True, eq=False)
class Feeds:
    """The fit takes the projections as they come. `fit` and `batches` change in place, so only the newest `Feeds` is
    valid. `batches` changes in place so that the projections are in memory only once.

    Attributes:
        correction: the correction of the next projections; it keeps what it learnt from the earlier ones.
        axis_col: the rotation axis in pixels of the file.
        search: how the axis was found. While it is not settled, a better axis may be found.
        fit: the fit; it has used the projections of `batches` and the newest one.
        batches: line integrals of the projections with their final correction.
        newest: the projection after those of `batches`; None: there is no such projection. The fit uses it already, but
            the projection is corrected again together with the next one.
        part: the part of the file whose projections were corrected last.
        history: progress so far, with that of the fits before the axis changed.
        told_behind: True if it was reported that the fit is slower than the scan.
    """

    correction: FedCorrection
    axis_col: float
    search: AxisSearch
    fit: StreamingFit
    batches: list[Projections] = field(default_factory=list)
    newest: Projections | None = None
    part: int = 0
    history: tuple[Progress, ...] = ()
    told_behind: bool = False

    @property
    def corrected(self) -> tuple[Projections, ...]:
        """Line integrals of all projections that the fit has, in batches, the newest projection last."""
        return (*self.batches, *(() if self.newest is None else (self.newest,)))

    @property
    def n_views(self) -> int:
        """Number of projections that the fit has."""
        return sum(batch.view_ids.size for batch in self.corrected)


@dataclass(frozen=True, eq=False)
class LastFit:
    """The scan has ended, and all projections are corrected: only the final fit remains.

    Attributes:
        prepared: all projections with the final correction, to which the model was fitted, and the laterally offset
            projections.
        fit, axis_col, history: see `Feeds`.
    """

    prepared: PreparedProjections
    fit: StreamingFit
    axis_col: float
    history: tuple[Progress, ...]


Following = WaitsForReferences | WaitsForAxis | Feeds
"""The states in which the file is read."""
