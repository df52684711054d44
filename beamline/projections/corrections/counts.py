"""Counts: line integrals are logarithms, or carry the likelihood of the photons counted."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, get_args

from beamline.projections.protocols import ScanPart
from beamline.projections.step import StepMemory, option, positive
from recon.base.choices import FEW_PHOTONS, Noise


@dataclass(frozen=True)
class CountModel:
    """How counts become line integrals. `ScanCorrection` asks for it.

    Attributes:
        noise: "log": logarithms of counts; "counts": line integrals and weights carry the likelihood of the counts;
            "auto": that where the open beam has few photons a pixel.
        gain: counts a photon, of single pixels; None finds it by the flats.
    """

    name: ClassVar[str] = "noise"
    follows: ClassVar[tuple[str, ...]] = ("defects",)
    needs_finished: ClassVar[str] = ""
    noise: Noise = option(
        "--noise",
        "auto",
        "log: line integrals are logarithms of counts. counts: line integrals and weights carry the likelihood "
        "of the photons counted, for few photons. auto: counts where a pixel of the open beam has fewer than "
        f"{FEW_PHOTONS}.",
        choices=get_args(Noise),
    )
    gain: float | None = option(
        "--gain", None, "Counts a photon, for --noise. Default: as the flats vary.", parse=positive, metavar="COUNTS"
    )

    def __post_init__(self) -> None:
        if self.gain is not None and self.noise == "log":
            raise ValueError("--gain is for counted photons; it does not go with --noise log.")

    def memory(self, part: ScanPart) -> StepMemory:
        return StepMemory()
