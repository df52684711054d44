"""Flats: how changes of the beam between flats are followed, and the ring current of each frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, get_args

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory, option
from drivers.base.frame import FrameKind
from recon.base.choices import FlatFields


@dataclass(frozen=True)
class Flats:
    """The open beam of each view. It is known before counts become line integrals: `ScanCorrection` asks for it.

    Attributes:
        fields: "groups": a view's flat is interpolated between groups of flats; "dynamic": it has those components of
            their changes that the view shows, see `recon.prep.dynamic_flats`.
        ring_current: "use": views and flats are divided by the ring current that the file has for each frame.
    """

    name: ClassVar[str] = "flats"
    follows: ClassVar[tuple[str, ...]] = ("references",)
    needs_finished: ClassVar[str] = ""
    fields: FlatFields = option(
        "--flat-fields",
        "groups",
        "groups: interpolate the flat of a view between the means of groups of flats. dynamic: add the changes "
        "of the flats that the view shows, for a beam that moves (4 flats or more).",
        choices=get_args(FlatFields),
    )
    ring_current: str = option(
        "--ring-current",
        "ignore",
        "use: views and flats are divided by the current of each frame in the file (control/data of NXtomo).",
        choices=("ignore", "use"),
    )

    def memory(self, part: ScanPart) -> StepMemory:
        if self.fields != "dynamic":
            return StepMemory()
        from recon.prep.dynamic_flats import search_memory, view_memory

        pixels, flats = part.view_bytes() // 4, int((part.source.image_key == FrameKind.FLAT).sum())
        return StepMemory(view_memory(flats, pixels), search_memory(flats, pixels))
