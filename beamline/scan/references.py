"""Darks and flats of a running scan: collects them when they are recorded, and checks them before the projections."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from beamline.config.load import Config
from beamline.config.monitor import ReferencesSection, reference_limits
from beamline.core.events import Sink, Warned
from beamline.core.files import SCAN
from beamline.core.text import spans
from beamline.monitor.digest import FrameDigest, check_block
from beamline.monitor.evidence import Evidence, FrameStatistics, photons
from beamline.monitor.references import ReferenceLimits, reference_findings
from beamline.plan.plan import Block
from beamline.scan.tally import BlockTally
from beamline.storage.interrupted import scan_file
from beamline.storage.readers.open import open_scan
from drivers.base.frame import Frame, FrameKind
from recon.base.choices import FEW_PHOTONS


def first_state(config: Config, series: Path) -> Path | None:
    """The scan of the first state in the folder of a series, whose darks and flats this scan copies; None: it takes its
    own."""
    if not config.copies_references:
        return None
    runs = [run for end in ("", "-*") for run in series.glob(f"*_state1{end}/") if (run / SCAN).is_file()]
    return scan_file(max(runs)) if runs else None


def recorded_in(path: Path, block: Block) -> Sequence[Frame]:
    """Darks or flats of another scan for a block; empty if it does not have enough of them, or the block is of another
    kind."""
    if block.kind not in REFERENCES:
        return ()
    with open_scan(path) as source:
        rows = source.table.of_kind(block.kind)[: block.n]
        return [source.table.frame(row, source.read([row])[0]) for row in rows.tolist()] if rows.size == block.n else ()


def copied(tally: BlockTally, frames: Sequence[Frame], first_row: int) -> Iterator[Frame]:
    """The frames of another scan as those of a block, numbered from row `first_row`; `tally` counts them."""
    for trigger, frame in enumerate(frames):
        tally.frames += 1
        tally.rows[trigger] = first_row + trigger, frame.time
        yield replace(frame, index=first_row + trigger, trigger=trigger)


REFERENCES = (FrameKind.DARK, FrameKind.FLAT)
VIEWS = 4  # number of projections that are enough for a median


class ReferenceLog:
    """Collects the evidence of the darks, the flats and the first projections of a scan while they are recorded."""

    def __init__(self) -> None:
        self.evidence, self._before = Evidence(), FrameKind.INVALID

    def add(self, frame: Frame, digest: FrameDigest) -> None:
        """Add the next frame, in the order of the file. `digest` is the digest for the checks."""
        if frame.kind in REFERENCES or (frame.kind is FrameKind.PROJECTION and len(self.evidence.views) < VIEWS):
            statistics = FrameStatistics.of(
                frame.index, frame.kind, frame.exposure, digest, check_block(frame.counts.shape)
            )
            self.evidence = self.evidence.with_frame(statistics, begins=frame.kind is not self._before)
        self._before = frame.kind if frame.kind is not FrameKind.INVALID else self._before
        if frame.replaces >= 0:
            self.evidence = self.evidence.without({frame.replaces})

    def faults(self, limits: ReferenceLimits, planned: Sequence[Block] = ()) -> dict[str, str]:
        """The faults of darks and flats so far, by kind, each in one or more sentences.

        Args:
            planned: planned blocks that should be done by now. If a block of darks or flats has no frame, it is
                reported as missing.
        """
        missing = {
            block.kind.name: f"The scan did not take the {block.n} {block.kind.name.lower()}s that its plan has before "
            "the projections."
            for block in planned
            if block.kind in REFERENCES and not self.evidence.of_kind(block.kind)
        }
        findings = (finding for finding in reference_findings(self.evidence, limits) if finding.frames)
        return missing | {f"{finding.rule} {spans(finding.frames)}": finding.message for finding in findings}

    def too_few_photons(self, limits: ReferenceLimits, exposure: float) -> str | None:
        """A warning if noise would dominate the projections because a pixel in the open beam gets few photons;
        otherwise None. `exposure`: exposure of the projections in s."""
        faulty_rows = {row for finding in reference_findings(self.evidence, limits) for row in finding.frames}
        evidence = self.evidence.without(faulty_rows)
        flats, darks = (next(iter(evidence.of_kind(kind)), None) for kind in (FrameKind.FLAT, FrameKind.DARK))
        n_photons = photons(flats, darks) if flats and darks else None
        if not flats or n_photons is None:
            return None
        n_photons *= exposure / flats[0].exposure if flats[0].exposure > 0 else 1.0
        if not n_photons < FEW_PHOTONS:
            return None
        longer_exposure = exposure * FEW_PHOTONS / n_photons
        flat_frames = spans([flat.row for flat in flats])
        return (
            f"Expose for longer (scan.exposure_s={longer_exposure:.2g}, and scan.period_s to match), or bin the "
            "camera's pixels (devices.camera.binning): the beam is too weak. A pixel of the open beam has "
            f"{n_photons:.3g} photons per projection (from mean and variance of the flats {flat_frames}); expected "
            f"{FEW_PHOTONS} or more, because with fewer photons noise dominates the volume. `beamline tune` measures "
            "the photons per pixel."
        )


class ReferenceReport:
    """Warns about faults of darks and flats (once for each group), and about too little intensity (once).

    Args:
        exposure: exposure of the projections in s.
    """

    def __init__(self, section: ReferencesSection, exposure: float, sink: Sink) -> None:
        self._limits, self._exposure, self._sink = reference_limits(section), exposure, sink
        self._warned_of: set[str] = set()

    def faults(self, log: ReferenceLog, planned: Sequence[Block] = ()) -> Mapping[str, str]:
        """The faults of the darks and flats so far, as from `ReferenceLog.faults`."""
        faults = log.faults(self._limits, planned)
        few_photons = log.too_few_photons(self._limits, self._exposure)
        statements = faults if few_photons is None else {"little light": few_photons, **faults}
        for group in [group for group in statements if group not in self._warned_of]:
            self._warned_of.add(group)
            self._sink(Warned(statements[group]))
        return faults
