"""What a step can do: a filter of each view, a search for where the sample was, or a change of all views.

A plug-in meets one of `ViewStep`, `PlaceStep` and `ScanStep`. The module of a step is imported for every
help text: what reads files or needs numba, torch or scipy is imported where it is called.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal, Protocol, runtime_checkable

from beamline.projections.step import NamedStep, StepDone, StepMemory

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.selection import ScanSelection
    from beamline.projections.usable_views import UsableViews
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.rules.evidence import ScanEvidence
    from recon.base.geometry import Geometry
    from recon.prep.projections import Projections


@dataclass(frozen=True, eq=False)
class ScanPart:
    """The part of a scan that is to be used, before any frame is read.

    Attributes:
        geometry: of views as many and as large, binned, as those that are used.
    """

    source: ScanSource
    selection: ScanSelection
    geometry: Geometry

    def view_bytes(self, reach: int = 0) -> int:
        """Bytes of a float32 view, with so many rows on either side as far as the detector has them."""
        rows, cols = self.geometry.detector_shape
        return 4 * min(rows + 2 * reach, self.source.shape[0] // self.selection.binning) * cols


class PrepStep(NamedStep, Protocol):
    """A correction. Its ValueError on creation is bad usage."""

    @property
    def needs_finished(self) -> str:
        """Why the scan must have ended, as a sentence for who follows one; empty: it need not."""

    def memory(self, part: ScanPart) -> StepMemory:
        """The memory that it takes, known before any frame is read.

        Raises:
            ConfigError: the step does not fit the scan.
        """


@dataclass(frozen=True, eq=False)
class ViewFilter:
    """A step on the views of one scan, which it takes a batch at a time.

    Attributes:
        apply: views, and the row of the detector at which they begin, to as many views filtered; line integrals may be
            changed in place.
        reach: rows, binned, beside a row from which it takes something.
        mixes: the subject and verb that say who mixes neighbouring pixels.
    """

    apply: Callable[[Projections, int], Projections]
    reach: int
    mixes: str


@runtime_checkable
class ViewStep(PrepStep, Protocol):
    """A step on each view alone, also of a scan that still runs."""

    def on(self, source: ScanSource, selection: ScanSelection) -> tuple[ViewFilter | None, StepDone]:
        """The filter of a scan, None where nothing is to be done; and what it does.

        Raises:
            ConfigError: the scan does not say what the step needs, or the step does not fit it.
        """


@runtime_checkable
class EstimatedStep(Protocol):
    """A step whose settings may be estimated from the corrected views of a finished scan."""

    def estimated(
        self, source: ScanSource, selection: ScanSelection, views: Projections, geometry: Geometry
    ) -> ViewStep | None:
        """The step with the settings that these views, corrected without it, determine; None if they determine none."""


@runtime_checkable
class BlurringStep(Protocol):
    """A step that blurs the views: what looks for fine detail leaves it out."""

    blurs: ClassVar[Literal[True]]


class ViewMotion(Protocol):
    """Where the sample was in the views of a scan.

    Attributes:
        frames: int64 [view], the rows of the file that are used.
        done: what the step did; its sentence becomes a warning.
    """

    @property
    def frames(self) -> NDArray[np.int64]: ...

    @property
    def done(self) -> StepDone: ...

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of these rows of the file, as the sample was in them."""


@dataclass(frozen=True, eq=False)
class Unmoved:
    """The motion of a sample that stood in all these views.

    Attributes:
        frames: int64 [view], rows of the file.
    """

    frames: NDArray[np.int64]
    done: ClassVar[StepDone] = StepDone(parameters={})

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        return geometry


@runtime_checkable
class PlaceStep(PrepStep, Protocol):
    """A step that finds where the sample was in each view, before views are corrected."""

    def place(
        self,
        source: ScanSource,
        selection: ScanSelection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewMotion:
        """The views that are used, where the sample was in them, and what was done.

        Args:
            usable: the views that may be used.
            progress: takes how much is done, and of how much at most.
        """


class GeometryLearnt(Protocol):
    """What was estimated of the geometry of some views.

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
    """A step that learns the geometry from the views of a finished scan.

    Attributes:
        asked_by: the option that asks for it.
        geometry: names of the terms that are to be estimated; "roll", "tilt" and "shifts" let rows show other slices.
        may_lean: views may come out rolled or tilted.
    """

    asked_by: ClassVar[str]

    @property
    def geometry(self) -> frozenset[str]: ...

    @property
    def may_lean(self) -> bool: ...

    def refuse_few(self, used: int, usable: int, cols: int) -> None:
        """Raises DataError for terms that need more views, used or usable, or more binned columns than there are."""

    def learn(
        self,
        scan: ScanEvidence,
        selection: ScanSelection,
        frames: NDArray[np.int64],
        geometry_before: Callable[[ScanSelection, NDArray[np.int64]], Geometry],
        progress: Callable[[int, int], None],
    ) -> GeometryLearnt:
        """The geometry of these frames, from views whose geometry is otherwise known.

        Raises:
            DataError: too few views, or nothing in the beam.
        """


@runtime_checkable
class ScanStep(PrepStep, Protocol):
    """A step on all views of a scan."""

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        """Change line integrals, weights and views held out in place.

        Args:
            angles: [view] of the stage, radians.
            progress: takes how much is done, and of how much at most.

        Raises:
            DataError: the views do not show what the step needs.
        """
