"""What a step is: a correction of views with its options, its place among the others, and what it says it did.

A step is a frozen dataclass. A field made by `option` is an option of the commands, of a recipe and of Python alike. A
module of a step is imported for every help text: what computes is imported where it is called.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.flags import UsableViews
    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.writers.recon_file import Value
    from recon.base.geometry import Geometry
    from recon.prep.correct import Projections


@dataclass(frozen=True)
class Option:
    """An option of a step on the command line.

    Attributes:
        name: with its dashes.
        help: for people.
        default: as it would be typed; None: there is nothing to type.
        parse: what is typed to the value of the field; its ValueError is bad usage.
        choices: what may be typed; empty: anything that `parse` takes.
        metavar: what stands for the value in help.
        path: it names a file.
    """

    name: str
    help: str
    default: str | None = None
    parse: Callable[[str], Any] = str
    choices: tuple[str, ...] = ()
    metavar: str | None = None
    path: bool = False


def option(name: str, default: str | None, help: str, **rest: Any) -> Any:
    """A field of a step that the option `name` sets; `rest` is as of `Option`. Its default is that of the option."""
    made = Option(name, help, default, **rest)
    return field(default=None if default is None else made.parse(default), metadata={"option": made})


def options_of(step: type[PrepStep]) -> dict[str, Option]:
    """The options of a step, by field."""
    return {each.name: each.metadata["option"] for each in fields(step) if "option" in each.metadata}  # type: ignore[arg-type]


def positive(text: str) -> float:
    """A finite number above 0. ValueError for anything else."""
    number = float(text)
    if not 0 < number < math.inf:
        raise ValueError(f"{text} is not in the range x>0")
    return number


@dataclass(frozen=True, eq=False)
class StepDone:
    """What a step did.

    Attributes:
        said: a sentence; empty where nothing was asked, or nothing found.
        parameters: what the file of the volume records of it, by name; None: the step's options, and `said`.
        warned: a warning told it.
    """

    said: str = ""
    parameters: Mapping[str, Value] | None = None
    warned: bool = False


@dataclass(frozen=True, eq=False)
class ScanPart:
    """The part of a scan that is to be used, before any frame is read.

    Attributes:
        geometry: of views as many and as large, binned, as those that are used.
    """

    source: ScanSource
    selection: Selection
    geometry: Geometry


@dataclass(frozen=True)
class StepMemory:
    """Bytes that a step takes at most, beside raw pixels, line integrals and volume.

    Attributes:
        correcting: while views are corrected, a batch at a time.
        alone: before or after that.
    """

    correcting: int = 0
    alone: int = 0

    @classmethod
    def of_all(cls, steps: Iterable[StepMemory]) -> StepMemory:
        """That of all steps, which act one after the other."""
        found = list(steps)
        return cls(max(each.correcting for each in found), max(each.alone for each in found))


class PrepStep(Protocol):
    """A correction. Its ValueError on creation is bad usage.

    Attributes:
        name: by which events and `PreparedProjections.done` know it.
        follows: names of steps that come before it.
    """

    name: ClassVar[str]
    follows: ClassVar[tuple[str, ...]]

    @property
    def needs_finished(self) -> str:
        """Why the scan must have ended, as a sentence for who follows one; empty: it need not."""

    def memory(self, part: ScanPart) -> StepMemory:
        """The memory that it takes, known before any frame is read.

        Raises:
            ConfigError: the step does not fit the scan.
        """


def view_bytes(part: ScanPart, reach: int = 0) -> int:
    """Bytes of a float32 view, with so many rows on either side as far as the detector has them."""
    rows, cols = part.geometry.detector_shape
    return 4 * min(rows + 2 * reach, part.source.shape[0] // part.selection.binning) * cols


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

    def on(self, source: ScanSource, selection: Selection) -> tuple[ViewFilter | None, StepDone]:
        """The filter of a scan, None where nothing is to be done; and what it does.

        Raises:
            ConfigError: the scan does not say what the step needs, or the step does not fit it.
        """


class ViewPlaces(Protocol):
    """Where the sample was in the views of a scan.

    Attributes:
        frames: int64 [view], the rows of the file that are used.
        said: what was done, in a line; empty: nothing.
        done: what the step did.
    """

    @property
    def frames(self) -> NDArray[np.int64]: ...

    @property
    def said(self) -> str: ...

    @property
    def done(self) -> StepDone: ...

    def corrected(self, geometry: Geometry, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of these rows of the file, as the sample was in them."""


@runtime_checkable
class PlaceStep(PrepStep, Protocol):
    """A step that finds where the sample was in each view, before views are corrected."""

    def place(
        self,
        source: ScanSource,
        selection: Selection,
        usable: UsableViews,
        axis_col: float,
        progress: Callable[[int, int], None],
    ) -> ViewPlaces:
        """The views that are used, where the sample was in them, and what was done.

        Args:
            usable: the views that may be used.
            progress: takes how much is done, and of how much at most.
        """


@runtime_checkable
class RayStep(PrepStep, Protocol):
    """A step that says what the rays of each view saw beside their angle."""

    def rays(self, source: ScanSource, selection: Selection, geometry: Geometry) -> tuple[Geometry, StepDone]:
        """The geometry of these views with it, and what was done.

        Raises:
            ConfigError: the step does not fit the scan.
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
