"""Flats and darks: decides which of them are used, and computes the open beam of each projection."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.sinks import Note
from beamline.core.text import count, spans
from beamline.monitor.evidence import BRIGHT
from beamline.projections.preparation import Preparation
from beamline.projections.read import read_binned, spoilt_frames
from beamline.projections.selection import SelectedScan
from beamline.storage.rules.evidence import ScanEvidence, by_exposure
from drivers.base.frame import FrameKind
from recon.prep.dynamic_flats import find_dynamic_flats
from recon.prep.references import References, dark_at, dead_pixels
from recon.prep.spots import without_spots

_STEADY = 0.01  # relative change of the ring current; top-up keeps it this constant


@dataclass(frozen=True, eq=False)
class _Reading:
    """Reads (binned) pixels of darks and flats, and finds the zingers in them.

    Attributes:
        open_beam_counts: counts in the open beam.
        spots: number of pixels in zingers, by frame.
    """

    evidence: ScanEvidence
    rows: slice
    binning: int
    use_damaged: bool
    open_beam_counts: float
    spots: dict[int, int] = field(default_factory=dict)

    @classmethod
    def of(cls, scan: SelectedScan, rows: slice) -> _Reading:
        binning = scan.selection.binning
        flat = read_binned(scan.source, scan.evidence.used_references.flats[0][:1], rows, binning)
        open_beam_counts = float(np.percentile(np.nan_to_num(flat), BRIGHT))
        return cls(scan.evidence, rows, binning, not scan.selection.step(Preparation).uses_flags, open_beam_counts)

    def images(self, frames: NDArray[np.int64]) -> Iterator[tuple[int, NDArray[Any]]]:
        """Yields the usable frames [row, col], without zingers."""
        usable_frames = list[int]()

        def good() -> Iterator[NDArray[Any]]:
            for frame in frames.tolist():
                image = read_binned(self.evidence.source, np.array([frame]), self.rows, self.binning)[0]
                if frame not in spoilt_frames(self.evidence.source, self.use_damaged):
                    usable_frames.append(frame)
                    yield image

        for number, (image, n) in enumerate(without_spots(good(), self.open_beam_counts)):
            if n:
                self.spots[usable_frames[number]] = n
            yield usable_frames[number], image

    def mean(self, frames: NDArray[np.int64], weights: NDArray[np.float64] | None = None) -> NDArray[np.float64] | None:
        """Mean of the usable frames, each multiplied by its weight [frame of the scan]. None if no frame is usable."""
        total: NDArray[np.float64] | float = 0.0
        n = 0
        for frame, image in self.images(frames):
            total = total + (image if weights is None else weights[frame] * image).astype(np.float64)
            n += 1
        return np.asarray(total / n) if n else None

    def darks(self, frames: NDArray[np.int64]) -> list[tuple[float, NDArray[np.float64]]]:
        """(exposure in s, mean dark) for each exposure. If exposures are equal or unknown: (NaN, mean of all darks)."""
        means = [
            (seconds, self.mean(same_exposure)) for seconds, same_exposure in by_exposure(self.evidence.table, frames)
        ]
        return [(seconds, mean) for seconds, mean in means if mean is not None]


def read_references(scan: SelectedScan, rows: slice) -> tuple[References, str]:
    """Read the mean dark, and the mean of each group of flats with its position in the scan; both kinds are required.
    Also returns a sentence about zingers; empty if there are no zingers.

    Damaged frames (see ScanSource) are left out, unless the selection uses all frames. Zingers in single frames are
    replaced. Flats with another exposure than the projections are scaled to the exposure of the
    projections: dark + (flat - its dark) * t / t_flat, if both are known. If darks have several exposures, each kind of
    frame has its own dark, see `recon.prep.references.dark_at`.

    Raises:
        DataError: all frames of a kind are damaged.
    """
    reading, evidence = _Reading.of(scan, rows), scan.evidence
    darks = reading.darks(np.concatenate(evidence.used_references.darks))
    dark = _dark_of(evidence.usual_exposure, darks)
    factors = intensity_factors_of(evidence, scan.selection.step(Preparation).by_current)
    flats = []
    for group in evidence.used_references.flats:
        mean = reading.mean(group, factors)
        if dark is not None and mean is not None:
            used = np.setdiff1d(group, spoilt_frames(scan.source, reading.use_damaged))
            flats_dark, mean_factor = (
                _dark_of(float(np.median(scan.table.exposures[used])), darks),
                factors[used].mean(),
            )
            net = (
                (1 - mean_factor) * dark
                if flats_dark is dark or flats_dark is None
                else dark - mean_factor * flats_dark
            )
            flats.append((float(used.mean()), (mean + net).astype(np.float32)))
    if dark is None or not flats:
        frames_kind = "darks" if dark is None else "flats"
        raise DataError(
            f"{scan.source.path}: all {frames_kind} are damaged: each frame is unreadable or differs from its stored "
            "checksum. Use an intact copy of the file. --flags ignore uses the frames whose checksum differs."
        )
    note = ""
    if reading.spots:
        n, frames = sum(reading.spots.values()), spans(sorted(reading.spots))
        spots = f"Zingers in darks and flats ({count(n, 'pixel')} in frames {frames})"
        note = Note(f"{spots} were replaced with the values of neighbouring frames.")
    return References(dark.astype(np.float32), tuple(flats), part_starts=tuple(scan.table.part_starts.tolist())), note


def _dark_of(exposure: float, darks: list[tuple[float, NDArray[np.float64]]]) -> NDArray[np.float64] | None:
    """The dark for an exposure. The mean of all darks if the exposure is unknown; None if there are no darks."""

    if len(darks) < 2:
        return darks[0][1] if darks else None
    return dark_at(exposure, darks) if exposure > 0 else np.asarray(np.mean([dark for _, dark in darks], axis=0))


def with_dynamic_flats(scan: SelectedScan, references: References, rows: slice) -> References:
    """The same references with the principal components of all flats that are used. The flats are read three times.

    Raises:
        ConfigError: there are too few flats.
    """

    preparation, groups = scan.selection.step(Preparation), scan.evidence.used_references
    frames = np.setdiff1d(np.concatenate(groups.flats), spoilt_frames(scan.source, not preparation.uses_flags))
    factors = intensity_factors_of(scan.evidence, preparation.by_current)
    reading = _Reading.of(scan, rows)
    darks = reading.darks(np.concatenate(groups.darks))

    def flats() -> Iterator[NDArray[np.float32]]:
        for frame, image in reading.images(frames):
            dark = references.dark if len(darks) < 2 else _dark_of(float(scan.table.exposures[frame]), darks)
            yield ((image - dark) * np.float32(factors[frame])).astype(np.float32)

    masked = dead_pixels(references.dark, [flat for _, flat in references.flats], preparation.hot_threshold)
    try:
        dynamic = find_dynamic_flats(flats, np.random.default_rng(scan.selection.seed), masked)
    except ValueError as error:
        raise ConfigError(f"Omit --flat-fields dynamic: {scan.source.path}: {error}.") from error
    return replace(references, dynamic=dynamic)


def intensity_factors_of(scan: ScanEvidence, by_current: bool = False) -> NDArray[np.float64]:
    """[frame] factor that scales each frame from its exposure to the median exposure of the projections; 1 if an
    exposure is unknown. With `by_current`, the ring current is scaled, too.
    """

    factors = _factors_to_median(scan.exposures, scan.table.views)
    return factors * current_factors(scan) if by_current else factors


def _factors_to_median(values: NDArray[np.float64], views: NDArray[np.int64]) -> NDArray[np.float64]:
    """The median value of the projections divided by the value of each frame; 1 if a value is unknown."""
    known = values[views][np.isfinite(values[views])]
    return np.where(np.isfinite(values), np.median(known) / values, 1.0) if known.size else np.ones(values.size)


def current_factors(scan: ScanEvidence) -> NDArray[np.float64]:
    """[frame] factor that scales each frame from its ring current to the median ring current of the projections.

    Raises:
        ConfigError: the file has no ring current for a projection or a flat.
    """
    rows = scan.table.of_kind(FrameKind.PROJECTION, FrameKind.FLAT)
    currents = scan.table.currents
    if currents is None or not np.isfinite(currents[rows]).all():
        lacking = "no ring current" if currents is None else "projections or flats without a ring current"
        raise ConfigError(f"Omit --ring-current use: {scan.source.path} has {lacking} (control/data of NXtomo).")
    return _factors_to_median(currents, scan.table.views)


def uncorrected_current(scan: SelectedScan) -> str:
    """The warning that the ring current changed between flats and projections and is not corrected; "" if it did not
    change.
    """
    all_currents = scan.table.currents
    if not scan.evidence.in_counts or scan.selection.step(Preparation).by_current or all_currents is None:
        return ""
    currents = all_currents[scan.table.of_kind(FrameKind.PROJECTION, FrameKind.FLAT)]
    if not currents.size or not (currents > 0).all() or currents.max() < (1 + _STEADY) * currents.min():
        return ""
    variation = currents.max() / currents.min() - 1
    return (
        f"Use --ring-current use: the ring current of flats and projections (control/data) varies by {variation:.0%} "
        f"(from {currents.min():.6g} to {currents.max():.6g}). Without this option, the change is not corrected, "
        "because no detector column shows air next to the sample."
    )


def flats_sentence(scan: ScanEvidence, references: References, by_current: bool) -> str:
    """A sentence that says how changes of the beam and of the exposure were corrected; empty if nothing was
    corrected.
    """

    sentences = []
    if scan.views_differ:
        views = scan.table.exposures[scan.table.views]
        sentences.append(
            f"The exposure times of the projections vary from {views.min():g} to {views.max():g} s; each projection "
            "was scaled to its exposure time."
        )
    if by_current:
        currents = 1 / current_factors(scan)[scan.table.views]
        sentences.append(
            f"The ring current of the projections varies from {currents.min():.3f} to {currents.max():.3f} times its "
            "median; each projection was scaled to its ring current."
        )
    if references.dynamic is not None:
        n = len(references.dynamic.components)
        sentences.append(
            f"Dynamic flats: {count(n, 'principal component')} of the flats, with a weight for each projection."
            if n
            else "Dynamic flats were not used, because the flats do not differ by more than noise; their mean is used."
        )
    return " ".join(sentences)


def parts_without_flats(scan: ScanEvidence, references: References) -> list[str]:
    """A warning for each part of the scan whose projections are corrected with flats of another part."""
    starts, warnings = scan.table.part_starts, list[str]()
    flats = [position for position, _ in references.flats]
    for start, end in zip(starts, [*starts[1:], len(scan.table)], strict=True):
        has_views = scan.table.views_of(start, end).size
        if has_views and not any(start <= position < end for position in flats):
            last = end - 1
            warnings.append(
                f"Frames {start}-{last}, a part of the scan, have no usable flats. Their projections are corrected "
                "with the nearest flats of another part, although the beam may have changed."
            )
    return warnings
