"""Calibration: what the scan does not state of its geometry and its detector is learnt from the views themselves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, ClassVar

from beamline.core.errors import DataError
from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.calibrate import Calibrated
    from beamline.projections.prepared import PreparedProjections
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from recon.base.geometry import Geometry

GEOMETRY = "axis", "roll", "tilt", "shifts"
OF_VIEWS: dict[str, str] = {
    "background": "beamline.projections.learnt_terms:without_learnt_background",
    "gains": "beamline.projections.learnt_terms:without_learnt_gains",
}
"""Terms that change line integrals: name, and `module:function` that changes views in place, is
told progress and returns a StepDone. Each takes its line here."""


def _terms(text: str) -> tuple[str, ...]:
    """A list of terms without "none"; in the order of the registry."""
    names = [name.strip() for name in text.split(",")]
    if names == ["none"]:
        return ()
    every = *GEOMETRY, *OF_VIEWS
    unknown = [name for name in names if name not in every]
    if unknown:
        raise ValueError(f"{', '.join(unknown)!r} is not known; choose from {', '.join(every)}")
    return tuple(name for name in every if name in names)


@dataclass(frozen=True)
class Calibrate:
    """What is learnt from the views.

    Attributes:
        terms: names; none: nothing.
    """

    name: ClassVar[str] = "calibrate"
    follows: ClassVar[tuple[str, ...]] = ("jumps", "poses", "background")
    terms: tuple[str, ...] = option(
        "--calibrate",
        "none",
        "What is learnt from the views, a list of: axis, roll (its lean in the detector's plane), tilt (along the "
        "beam), shifts (of each view), background (of the beam), gains (of pixels). Geometry is not resampled; what "
        "views held out do not confirm stays as it was.",
        parse=_terms,
        metavar="LIST",
    )

    @property
    def geometry(self) -> frozenset[str]:
        """The terms that change the geometry."""
        return frozenset(self.terms).intersection(GEOMETRY)

    @property
    def may_lean(self) -> bool:
        """Whether views may come out rolled or tilted: a row then shows several slices."""
        return not self.geometry.isdisjoint({"roll", "tilt"})

    @property
    def needs_finished(self) -> str:
        return "--calibrate is for a finished scan: it needs all views." if self.terms else ""

    def memory(self, part: ScanPart) -> StepMemory:
        from beamline.projections.calibrate import search_memory
        from beamline.projections.learnt_terms import MEMORY

        terms = [MEMORY[term](part.geometry) for term in self.terms if term in MEMORY]
        return StepMemory(alone=max([search_memory(part, self.geometry), *terms]))

    def refuse_few(self, used: int, usable: int, cols: int) -> None:
        """Raises DataError for terms that need more views, used or usable, or more binned columns than there are."""
        from beamline.projections.learnt_terms import LEAST
        from recon.calibration.learn import LEAST_VIEWS

        for term in self.terms:
            (least, wide), views = LEAST.get(term, (LEAST_VIEWS, 1)), used if term in LEAST else usable
            if views < least or cols < wide:
                raise DataError(
                    f"--calibrate {term}: {views} views of {cols} columns are too few; {least} of {wide} are needed. "
                    "Leave it out. No view was read."
                )

    def learn(
        self,
        source: ScanSource,
        selection: Selection,
        frames: NDArray[np.int64],
        seen: Callable[[Selection, NDArray[np.int64]], Geometry],
        progress: Callable[[int, int], None],
    ) -> Calibrated:
        from beamline.projections.calibrate import calibrated

        return calibrated(source, selection, frames, seen, self.geometry, progress)

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        if not self.terms:
            return StepDone(parameters={})
        done = [views.done[self.name]] if self.name in views.done else []
        for term, place in OF_VIEWS.items():
            if term in self.terms:
                module, function = place.split(":")
                done.append(getattr(import_module(module), function)(views, progress))
        said = " ".join(each.said for each in done if each.said)
        values = {key: value for each in done for key, value in (each.parameters or {}).items()}
        return StepDone(said, {"calibrate": ",".join(self.terms), "calibrate_said": said, **values})
