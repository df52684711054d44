"""Protocols of a correction step. A step sets how counts are converted, filters each projection, finds the position of
the sample, or changes all projections.

A plug-in implements `ViewStep`, `PlaceStep` or `ScanStep`. The module of a step is imported for every help text.
Therefore import modules that read files or need numba, torch or scipy inside the function that uses them.
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
    """The part of a scan that will be used, described before any frame is read.

    Attributes:
        geometry: a geometry with the number and the (binned) size of the projections that will be used.
    """

    scan: SelectedScan
    geometry: Geometry

    def view_bytes(self, reach: int = 0) -> int:
        """Size in bytes of a float32 projection with additional rows on either side, as far as the detector has
        them.
        """
        rows, cols = self.geometry.detector_shape
        return 4 * min(rows + 2 * reach, self.scan.source.shape[0] // self.scan.selection.binning) * cols


class PrepStep(NamedStep, Protocol):
    """A correction. A ValueError on creation means wrong usage."""

    @property
    def needs_finished(self) -> str:
        """A sentence for the user who follows a running scan that says why the step needs a finished scan. Empty: the
        step does not need a finished scan.
        """

    def memory(self, part: ScanPart) -> StepMemory:
        """The memory that the step needs. It is computed before any frame is read.

        Raises:
            ConfigError: the step does not fit the scan.
        """


@runtime_checkable
class CountsStep(PrepStep, Protocol):
    """A step that sets how counts become line integrals."""

    def settings(self, before: CorrectionSettings) -> CorrectionSettings:
        """The settings of the correction, changed by the options of the step."""


@dataclass(frozen=True, eq=False)
class ViewFilter:
    """A filter of the projections of one scan, which works on one batch at a time.

    Attributes:
        apply: function of projections and of the detector row at which they begin. Returns the same number of filtered
            projections; line integrals may be changed in place.
        reach: number of binned rows above and below a row that the filter needs.
        mixes: subject and verb of a sentence that says which option mixes neighbouring pixels; for messages.
    """

    apply: Callable[[Projections, int], Projections]
    reach: int
    mixes: str


@runtime_checkable
class ViewStep(PrepStep, Protocol):
    """A step that changes each projection separately. It can also be used while a scan is running."""

    def on(self, scan: SelectedScan) -> tuple[ViewFilter | None, StepDone]:
        """The filter for a scan (None if there is nothing to do), and what the filter does.

        Raises:
            ConfigError: the scan does not state what the step needs, or the step does not fit it.
        """


@runtime_checkable
class EstimatedStep(Protocol):
    """A step whose settings may be estimated from the corrected projections of a finished scan."""

    def estimated(
        self, scan: SelectedScan, views: Projections, geometry: Geometry, progress: Callable[[int, int], None]
    ) -> ViewStep | None:
        """The step with the settings that these projections determine; they are corrected without the step. None if
        they determine no settings.

        Args:
            progress: function that gets the amount of work that is done, and of all work.
        """


class ViewMotion(Protocol):
    """The position of the sample in the projections of a scan.

    Attributes:
        frames: int64 [view], the rows of the file that are used.
        done: what the step did. The sentence in it becomes a warning.
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
        """Find the projections to use and the position of the sample in them. The result also says what was done.

        Args:
            usable: the projections that may be used.
            progress: takes how much is done, and of how much at most.
        """


class GeometryLearnt(Protocol):
    """The estimated geometry of some projections.

    Attributes:
        axis: displacement of the rotation axis in the detector's middle row, in columns.
        done: what the step did.
    """

    @property
    def axis(self) -> float: ...

    @property
    def done(self) -> StepDone: ...

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        """The estimated geometry of these rows of the file, which may be binned."""


@runtime_checkable
class GeometryStep(PrepStep, Protocol):
    """A step that finds the geometry from the projections of a finished scan.

    Attributes:
        requested_by: the option that asks for it.
        geometry: names of the terms that are to be estimated. With "roll", "tilt" or "shifts", a detector row may show
            several slices.
        may_roll_or_tilt: True if the estimated projections may be rolled or tilted.
    """

    requested_by: ClassVar[str]

    @property
    def geometry(self) -> frozenset[str]: ...

    @property
    def may_roll_or_tilt(self) -> bool: ...

    def refuse_few(self, used: int, usable: int, cols: int) -> None:
        """Raise DataError if a term needs more projections (used or usable), or more binned columns, than there are."""

    def learn(
        self,
        scan: SelectedScan,
        frames: NDArray[np.int64],
        geometry_before: Callable[[SelectedScan, NDArray[np.int64]], Geometry],
        progress: Callable[[int, int], None],
    ) -> GeometryLearnt:
        """The geometry of these frames, from projections whose geometry is otherwise known.

        Raises:
            DataError: there are too few projections, or no sample is in the beam.
        """


@runtime_checkable
class ScanStep(PrepStep, Protocol):
    """A step on all projections of a scan."""

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        """Change line integrals, weights and held-out projections in place.

        Args:
            angles: [view], angle of the stage in radians.
            progress: takes how much is done, and of how much at most.

        Raises:
            DataError: the projections do not show what the step needs.
        """
