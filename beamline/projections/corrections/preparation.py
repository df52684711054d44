"""Preparation: how flags, darks, flats and counts of a scan are used until line integrals are made of its views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, get_args

from beamline.projections.step import StepDone, StepMemory, option, positive
from recon.base.choices import FEW_PHOTONS, SPOT_ERRORS, FlatFields, Noise

if TYPE_CHECKING:
    from beamline.projections.protocols import ScanPart


@dataclass(frozen=True)
class Preparation:
    """How frames are converted to line integrals. `checked_views` and `OpenBeam` follow these settings.

    Attributes:
        flags: "use": views with an alarm are left out, those with a warning weigh less. "judge": the monitor looks at
            the frames now, and its flags count in place of the file's. "ignore": all views are alike.
        references: "accept": darks and flats are used as they are, also saturated, dark, uneven or lit ones.
        noise: "log": logarithms of counts; "counts": line integrals and weights carry the likelihood of the counts;
            "auto": that where the open beam has few photons a pixel.
        gain: counts a photon, of single pixels; None finds it by the flats.
        flat_fields: "groups": a view's flat is interpolated between groups of flats; "dynamic": it has those components
            of their changes that the view shows, see `recon.prep.dynamic_flats`.
        ring_current: "use": views and flats are divided by the ring current that the file has for each frame.
        floor, hot_threshold, zinger_threshold: which pixels are taken from their neighbours, see
            `recon.prep.counts_plan.CorrectionSettings`.
    """

    name: ClassVar[str] = "preparation"
    follows: ClassVar[tuple[str, ...]] = ()
    flags: str = option(
        "--flags",
        "use",
        "use: leave out views with an alarm of the monitor, halve the weight of views or regions with a warning, and "
        "correct views after a jump of the sample. judge: run the monitor on the frames first and use its flags. "
        "ignore: weigh all views equally.",
        choices=("use", "judge", "ignore"),
    )
    references: str = option(
        "--references",
        "check",
        "check: leave out groups of darks and flats with a fault (saturated, dark, uneven or lit); refuse the scan if "
        "no group remains. accept: use all as they are.",
        choices=("check", "accept"),
    )
    noise: Noise = option(
        "--noise",
        "auto",
        "log: line integrals are logarithms of counts. counts: for few photons, line integrals and weights that "
        "represent the likelihood of the counted photons. auto: counts if a pixel of the open beam has fewer than "
        f"{FEW_PHOTONS}.",
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
        "groups: interpolate the flat of each view between the means of the groups of flats. dynamic: for a beam that "
        "moves, also add those variations of the flats that the view shows (needs 4 flats or more).",
        choices=get_args(FlatFields),
    )
    ring_current: str = option(
        "--ring-current",
        "ignore",
        "use: divide views and flats by the ring current of each frame in the file (control/data of NXtomo).",
        choices=("ignore", "use"),
    )
    floor: float = 1e-4
    hot_threshold: float = 10.0
    zinger_threshold: float = SPOT_ERRORS

    def __post_init__(self) -> None:
        if self.gain is not None and self.noise == "log":
            raise ValueError("--gain is for --noise counts; it has no effect with --noise log. Leave one of them out.")

    @property
    def uses_flags(self) -> bool:
        """Whether flags, those of the file or new ones, decide about views."""
        return self.flags != "ignore"

    @property
    def judged(self) -> bool:
        """Whether the monitor checks the frames first."""
        return self.flags == "judge"

    @property
    def accepted(self) -> bool:
        """Whether all groups of references are used, even faulty ones."""
        return self.references == "accept"

    @property
    def by_current(self) -> bool:
        """Whether views and flats are divided by the ring current."""
        return self.ring_current == "use"

    @property
    def done(self) -> StepDone:
        """What the volume's file records of the preparation, apart from the record of `OpenBeam`."""
        return StepDone(parameters={"flags": self.flags, "references": self.references})

    @property
    def needs_finished(self) -> str:
        sentence = "--flags judge is for a finished scan; a running one is judged while it is taken."
        return sentence if self.judged else ""

    def memory(self, part: ScanPart) -> StepMemory:
        if self.flat_fields != "dynamic":
            return StepMemory()
        from recon.prep.dynamic_flats import search_memory, view_memory

        pixels, flats = part.view_bytes() // 4, part.source.table.flats.size
        return StepMemory(view_memory(flats, pixels), search_memory(flats, pixels))
