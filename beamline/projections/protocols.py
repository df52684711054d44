"""Protocols of a correction step: settings of the conversion of counts, a filter of each projection, a search for the
sample's position, or a change of all projections.

A plug-in meets one of `ViewStep`, `PlaceStep` and `ScanStep`. The module of a step is imported for every help text:
import what reads files or needs numba, torch or scipy in the function that uses it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Protocol, runtime_checkable

from beamline.projections.step import NamedStep, StepDone, StepMemory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.selection import SelectedScan
    from beamline.projections.usable_views import UsableViews
    from recon.base.geometry import Geometry
    from recon.prep.counts_plan import CorrectionSettings
    from recon.prep.projections import Projections


@dataclass(frozen=True, eq=False)
class ScanPart:
    """The part of a scan that is to be used, before any frame is read.

    Attributes:
        geometry: of as many projections as are used, of the same size, binned.
    """

    scan: SelectedScan
    geometry: Geometry

    def view_bytes(self, reach: int = 0) -> int:
        """Bytes of a float32 projection with this many more rows on either side, as far as the detector has them."""
        rows, cols = self.geometry.detector_shape
        return 4 * min(rows + 2 * reach, self.scan.source.shape[0] // self.scan.selection.binning) * cols


class PrepStep(NamedStep, Protocol):
    """A correction. Its ValueError on creation is bad usage."""

    @property
    def needs_finished(self) -> str:
        """Why the step needs a finished scan, as a sentence for the user who follows a running one; empty: it does
        not need one.
        """

    def memory(self, part: ScanPart) -> StepMemory:
        """The memory that the step needs, known before any frame is read.

        Raises:
            ConfigError: the step does not fit the scan.
        """


@runtime_checkable
class CountsStep(PrepStep, Protocol):
    """A step that sets how counts become line integrals."""

    def settings(self, before: CorrectionSettings) -> CorrectionSettings:
        """These settings of the correction, changed as the options of the step say."""


@dataclass(frozen=True, eq=False)
class ViewFilter:
    """A step on the projections of one scan, a batch at a time.

    Attributes:
        apply: (projections, detector row at which they begin) to as many filtered projections; line integrals may be
            changed in place.
        reach: how many rows, binned, above and below a row it needs.
        mixes: subject and verb of a sentence that says which option mixes neighbouring pixels.
    """

    apply: Callable[[Projections, int], Projections]
    reach: int
    mixes: str


@runtime_checkable
class ViewStep(PrepStep, Protocol):
    """A step on each projection alone, also of a scan that is still running."""

    def on(self, scan: SelectedScan) -> tuple[ViewFilter | None, StepDone]:
        """The filter of a scan, None if there is nothing to do; and what it does.

        Raises:
            ConfigError: the scan does not state what the step needs, or the step does not fit it.
        """


@runtime_checkable
class EstimatedStep(Protocol):
    """A step whose settings may be estimated from the corrected projections of a finished scan."""

    def estimated(self, scan: SelectedScan, views: Projections, geometry: Geometry) -> ViewStep | None:
        """The step with the settings that these projections, corrected without it, determine; None if they determine
        none.
        """


class ViewMotion(Protocol):
    """The position of the sample in the projections of a scan.

    Attributes:
        frames: int64 [view], the rows of the file that are used.
        done: what the step did; its sentence becomes a warning.
    """

    @property
    def frames(self) -> NDArray[np.int64]: ...

    @property
    def done(self) -> StepDone: ...

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of these rows of the file, with the position of the sample in them."""


@dataclass(frozen=True, eq=False)
class Unmoved:
    """The motion of a sample that stayed in place in all these projections.

    Attributes:
        frames: int64 [view], rows of the file.
    """

    frames: NDArray[np.int64]
    done: ClassVar[StepDone] = StepDone(parameters={})

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        return geometry


@runtime_checkable
class PlaceStep(PrepStep, Protocol):
    """A step that finds the position of the sample in each projection, before projections are corrected."""

    def place(
        self,
        scan: SelectedScan,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        """The projections that are used, the position of the sample in them, and what was done.

        Args:
            usable: the projections that may be used.
            progress: takes how much is done, and of how much at most.
        """


class GeometryLearnt(Protocol):
    """What was estimated of the geometry of some projections.

    Attributes:
        axis: displacement of the rotation axis in the detector's middle row, in columns.
        done: what the step did.
    """

    @property
    def axis(self) -> float: ...

    @property
    def done(self) -> StepDone: ...

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of these rows of the file, which may be binned, as it was estimated."""


@runtime_checkable
class GeometryStep(PrepStep, Protocol):
    """A step that finds the geometry from the projections of a finished scan.

    Attributes:
        asked_by: the option that asks for it.
        geometry: names of the terms that are to be estimated; with "roll", "tilt" and "shifts" a row may show other
            slices.
        may_lean: projections may come out rolled or tilted.
    """

    asked_by: ClassVar[str]

    @property
    def geometry(self) -> frozenset[str]: ...

    @property
    def may_lean(self) -> bool: ...

    def refuse_few(self, used: int, usable: int, cols: int) -> None:
        """Raise DataError for terms that need more projections, used or usable, or more binned columns than there
        are.
        """

    def learn(
        self,
        scan: SelectedScan,
        frames: NDArray[np.int64],
        geometry_before: Callable[[SelectedScan, NDArray[np.int64]], Geometry],
        progress: Callable[[int, int], None],
    ) -> GeometryLearnt:
        """The geometry of these frames, from projections whose geometry is otherwise known.

        Raises:
            DataError: too few projections, or nothing in the beam.
        """


@runtime_checkable
class ScanStep(PrepStep, Protocol):
    """A step on all projections of a scan."""

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        """Change line integrals, weights and held-out projections in place.

        Args:
            angles: [view] of the stage, radians.
            progress: takes how much is done, and of how much at most.

        Raises:
            DataError: the projections do not show what the step needs.
        """
