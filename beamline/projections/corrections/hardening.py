"""Beam hardening: line integrals by the curve of a stated material and beam, or of what the views themselves show."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections

    Spectrum = tuple[NDArray[np.float64], NDArray[np.float64]]


def _wanted(text: str) -> str | None:
    """`fit` or `material:beam`; None for "none"."""
    if text not in ("none", "fit") and not re.fullmatch(r"[^:]+:.+", text):
        raise ValueError(
            f"{text!r} is not known; expected none, fit or MATERIAL:BEAM (Al:60kV,Al=1 is a tube behind 1 mm Al; or "
            "Al:FILE)"
        )
    return None if text == "none" else text


@dataclass(frozen=True)
class Hardening:
    """How beam hardening is corrected.

    Attributes:
        wanted: "fit": by a curve that is fitted on the views; `material:beam` as the user said it; None: not at all.
        spectrum: the material's attenuation, in any unit, at the energies of the beam, and their shares of the detected
            light; None: that of `wanted`.
    """

    name: ClassVar[str] = "hardening"
    follows: ClassVar[tuple[str, ...]] = ("rings",)
    wanted: str | None = option(
        "--hardening",
        "none",
        "Beam hardening of a sample of one material. fit: by its own views; BEAM: 60kV (a tube), 60kV,Al=1,Cu=0.1 "
        "(behind mm of filters), or a text file of lines: keV weight.",
        parse=_wanted,
        metavar="none|fit|MATERIAL:BEAM",
    )
    spectrum: Spectrum | None = field(default=None, compare=False)

    def __post_init__(self) -> None:
        if self.wanted is None or self.wanted == "fit" or self.spectrum is not None:
            return
        from beamline.projections.hardening import in_beam

        try:
            object.__setattr__(self, "spectrum", in_beam(*self.wanted.split(":", 1)))
        except ValueError as error:
            raise ValueError(f"--hardening {self.wanted}: {error}.") from error

    @property
    def needs_finished(self) -> str:
        return "" if self.wanted is None else "--hardening is for a finished scan: its curve is of all views."

    def memory(self, part: ScanPart) -> StepMemory:
        from beamline.projections.hardening import curve_memory

        return StepMemory(alone=0 if self.wanted is None else curve_memory(part.geometry, self))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        if self.wanted is None:
            return StepDone("", {"hardening": "not corrected"})
        from beamline.projections.hardening import curve_of

        curve, said = curve_of(views.projections.data, views.geometry, self)
        if curve is not None:
            curve.linearise(views.projections.data, views.projections.weights)
            if views.held_out is not None:
                curve.linearise(views.held_out[0])
        return StepDone(said, {"hardening": said})
