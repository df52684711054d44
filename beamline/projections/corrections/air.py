"""Air: a view's air is scaled by its edge columns; its background is fitted on all rays that miss the sample."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepDone, StepMemory, option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections

Columns = Literal["none", "auto"] | tuple[int, int]
Surface = Literal["auto", "none"] | int
"""The surface that is taken off as the background of the beam: by its order, or "auto" where the views confirm it."""

_MODELS: dict[str, tuple[Columns, Surface]] = {
    "auto": ("auto", "auto"), "columns": ("auto", "none"), "none": ("none", "none"),
}  # fmt: skip


def _parts(text: str) -> tuple[Columns, Surface]:
    """Which columns at the detector's edges show air, and the surface that is taken off."""
    if match := re.fullmatch(r"(\d+),(\d+)", text):
        return (int(match[1]), int(match[2])), "none"
    if match := re.fullmatch(r"surface:([0-3])", text):
        return "auto", int(match[1])
    if text not in _MODELS:
        raise ValueError(
            f"{text!r} is not known; expected auto, none, columns, LEFT,RIGHT (numbers of columns, e.g. 12,12) or "
            "surface:ORDER (0 to 3)"
        )
    return _MODELS[text]


def _model(text: str) -> str:
    _parts(text)
    return text


@dataclass(frozen=True)
class Air:
    """Takes a background off each view, so that its air is at zero.

    Attributes:
        model: as the option says it.
    """

    name: ClassVar[str] = "background"
    follows: ClassVar[tuple[str, ...]] = ("jumps",)
    needs_finished: ClassVar[str] = ""
    model: str = option(
        "--air",
        "auto",
        "Level the air of each view at zero. columns: take off the line through the air at both edges. "
        "LEFT,RIGHT: from so many columns. surface:0 to 3: take off a polynomial through all rays that miss the "
        "sample, too. auto: the surface where the views confirm it.",
        parse=_model,
        metavar="auto|none|columns|LEFT,RIGHT|surface:ORDER",
    )

    @property
    def columns(self) -> Columns:
        """(left, right) columns of air, as of `recon.prep.correct.CorrectionSettings`, which takes them."""
        return _parts(self.model)[0]

    @property
    def sample_from(self) -> float:
        """Line integral at the edges from which they are sample, as for the monitor; columns asked for are air."""
        from beamline.monitor.field import FieldOfViewCheck

        return FieldOfViewCheck.edge if self.model == "auto" else math.inf

    @property
    def surface(self) -> Surface:
        """See `beamline.projections.background`."""
        return _parts(self.model)[1]

    def memory(self, part: ScanPart) -> StepMemory:
        from beamline.projections.background import background_memory

        return StepMemory(alone=0 if self.surface == "none" else background_memory(part.geometry))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        import numpy as np

        from beamline.projections.background import without_background
        from recon.base.masks import areas

        air = views.projections.air
        levelled = float(np.mean(-np.log(air[air > 0]))) if (air > 0).any() else 0.0
        said, terms = without_background(
            views.projections.data, views.geometry, self.surface, views.held_out, areas(views.projections.masked),
            levelled,
        )  # fmt: skip
        line = any(views.projections.air_columns)
        nothing = "no surface taken off, a line through the air at the edges" if line else "none taken off"
        parameters: dict[str, Any] = {"surface": self.surface, "background": said or nothing}
        return StepDone(said, parameters if terms is None else {**parameters, "background_terms": terms})
