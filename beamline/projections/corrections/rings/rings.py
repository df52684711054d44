"""Rings: removes stripes from the sinograms, see `recon.features.rings`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, get_args

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepDone, StepMemory, option
from recon.base.choices import Rings as Way

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from beamline.projections.prepared import PreparedProjections


@dataclass(frozen=True)
class Rings:
    """Removal of stripes from line integrals.

    Attributes:
        way: how stripes are removed, see `recon.features.rings.remove_rings_in_place`.
    """

    name: ClassVar[str] = "rings"
    follows: ClassVar[tuple[str, ...]] = ("background", "calibrate")
    way: Way = option(
        "--rings",
        "none",
        "Remove the stripes in sinograms that make rings in slices. none: remove nothing. sort: small stripes. "
        "vo: dead columns, large and small stripes. auto: only the kinds of stripes that are found in the "
        "projections. Layers of the sample around the axis are kept.",
        choices=get_args(Way),
    )

    needs_finished: ClassVar[str] = ""

    def memory(self, part: ScanPart) -> StepMemory:
        from recon.features.rings import removal_memory

        return StepMemory(alone=removal_memory(part.geometry.n_views, part.geometry.detector_shape, self.way))

    def apply(
        self, views: PreparedProjections, angles: NDArray[np.float64], progress: Callable[[int, int], None]
    ) -> StepDone:
        from recon.features.rings import remove_rings_in_place, rings_seen

        data, axis_col = views.seen.data, views.geometry.axis_col
        if self.way == "none":
            sentence = rings_seen(data, angles, axis_col)
            return StepDone(sentence, {"rings": self.way, **({"rings_seen": sentence} if sentence else {})})
        stripes, sentence = remove_rings_in_place(data, angles, self.way, axis_col)
        views.lines.data[views.n_used :] -= stripes
        return StepDone(sentence, {"rings": self.way, **({"rings_removed": sentence} if sentence else {})})
