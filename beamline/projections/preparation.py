"""Preparation: settings for the use of flags, darks, flats and counts, when the frames of a scan are converted to line
integrals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, get_args

from beamline.projections.step import StepDone, StepMemory, option, positive
from recon.base.choices import FEW_PHOTONS, SPOT_ERRORS, FlatFields, Noise

if TYPE_CHECKING:
    from beamline.projections.protocols import ScanPart
    from recon.prep.counts_plan import CorrectionSettings


@dataclass(frozen=True)
class Preparation:
    """How frames are converted to line integrals. `checked_views` and the correction follow these settings.

    Attributes:
        flags: "use": projections with an alarm are left out, those with a warning get less weight. "judge": the monitor
            checks the frames now, and the new flags replace the flags in the file. "ignore": all projections have equal
            weight.
        references: "accept": all darks and flats are used as they are, even if they are saturated, dark or uneven, or
            if darks were exposed to the beam.
        noise: "log": logarithms of counts; "counts": line integrals and weights that represent the likelihood of the
            counts; "auto": "counts" if the open beam has few photons per pixel.
        gain: counts per photon of a single pixel; None: found from the flats.
        flat_fields: "groups": a projection's flat is interpolated between groups of flats; "dynamic": principal
            components of the flats are added with the amplitudes that the projection shows, see
            `recon.prep.dynamic_flats`.
        ring_current: "use": projections and flats are divided by the ring current that the file has for each frame.
        floor, hot_threshold, zinger_threshold: which pixels are replaced with values of their neighbours, see
            `recon.prep.counts_plan.CorrectionSettings`.
    """

    name: ClassVar[str] = "preparation"
    follows: ClassVar[tuple[str, ...]] = ()
    flags: str = option(
        "--flags",
        "use",
        "use: leave out projections with an alarm of the monitor, halve the weight of projections or regions with a "
        "warning, and correct projections after a jump of the sample. judge: run the monitor on the frames first "
        "and use the flags of this run. ignore: weigh all projections equally.",
        choices=("use", "judge", "ignore"),
    )
    references: str = option(
        "--references",
        "check",
        "check: leave out groups of darks and flats with a fault (saturated, dark, uneven, or darks exposed to "
        "the beam); stop with an error if no group remains. accept: use all darks and flats as they are.",
        choices=("check", "accept"),
    )
    noise: Noise = option(
        "--noise",
        "auto",
        "Noise model. log: line integrals are logarithms of counts. counts: for few photons; line integrals and "
        "weights follow from the likelihood of the counted photons. auto: counts if a pixel of the open beam "
        f"has fewer than {FEW_PHOTONS}.",
        choices=get_args(Noise),
    )
    gain: float | None = option(
        "--gain",
        None,
        "Counts per photon, for --noise. Default: from the variance of the flats.",
        parse=positive,
        metavar="COUNTS",
    )
    flat_fields: FlatFields = option(
        "--flat-fields",
        "groups",
        "groups: the flat of a projection is interpolated between the mean flats before and after it. dynamic: for "
        "a beam that moves, also add the variations of the flats, with weights that are fitted to each projection "
        "(needs 4 flats or more).",
        choices=get_args(FlatFields),
    )
    ring_current: str = option(
        "--ring-current",
        "ignore",
        "use: divide projections and flats by the ring current of each frame in the file (control/data of NXtomo). "
        "ignore: do not use the ring current.",
        choices=("ignore", "use"),
    )
    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = SPOT_ERRORS

    def __post_init__(self) -> None:
        if self.gain is not None and self.noise == "log":
            raise ValueError("Omit --gain or --noise log: --gain has an effect only with --noise counts.")

    def settings(self, before: CorrectionSettings) -> CorrectionSettings:
        """These settings with the limits of the pixels that are replaced."""
        return replace(
            before, floor=self.floor, hot_threshold=self.hot_threshold, zinger_threshold=self.zinger_threshold
        )

    @property
    def uses_flags(self) -> bool:
        """True if flags (those in the file, or new ones) decide how projections are used."""
        return self.flags != "ignore"

    @property
    def judged(self) -> bool:
        """True if the monitor checks the frames first."""
        return self.flags == "judge"

    @property
    def accepted(self) -> bool:
        """True if all groups of references are used, even faulty ones."""
        return self.references == "accept"

    @property
    def by_current(self) -> bool:
        """True if projections and flats are divided by the ring current."""
        return self.ring_current == "use"

    @property
    def done(self) -> StepDone:
        """What the file of the volume records about the preparation, apart from `ScanCorrectionPlan.beam_done`."""
        return StepDone(parameters={"flags": self.flags, "references": self.references})

    @property
    def needs_finished(self) -> str:
        sentence = "--flags judge needs a finished scan, because the monitor already checks a scan that is running."
        return sentence if self.judged else ""

    def memory(self, part: ScanPart) -> StepMemory:
        if self.flat_fields != "dynamic":
            return StepMemory()
        from recon.prep.dynamic_flats import search_memory, view_memory

        pixels, flats = part.view_bytes() // 4, part.scan.source.table.flats.size
        return StepMemory(view_memory(flats, pixels), search_memory(flats, pixels))
