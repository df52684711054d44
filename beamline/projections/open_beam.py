"""Open beam of a scan: finds objects that are in the beam of all projections, and the photon statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.monitor.evidence import lit_places
from beamline.projections.preparation import Preparation
from beamline.projections.read import read_binned, spoilt_frames
from beamline.projections.selection import SelectedScan
from beamline.storage.readers.base import ScanSource
from recon.base.arrays import Mask
from recon.base.choices import FEW_PHOTONS
from recon.base.views import spread
from recon.prep.counts import Photons, photon_transfer
from recon.prep.counts_plan import CorrectionSettings, survey
from recon.prep.lines_plan import LinesPlan
from recon.prep.references import SHADOW_REACH, References, shadowed
from recon.prep.unmeasured import foreign_rows

# search for an object in the beam: fewest and most projections that are examined, and rows at a time
_LEAST_VIEWS, SHADOW_VIEWS, _BAND = 8, 16, 64

# bool [row, col], objects that are in the beam of all projections; bool [row], rows in which objects other than the
# sample come and go (`foreign_rows`)
Shadow = tuple[Mask, Mask]


def shadow_on_counts(
    source: ScanSource,
    views: NDArray[np.int64],
    read: slice,
    binning: int,
    references: References,
    settings: CorrectionSettings,
) -> Shadow | None:
    """Objects that are in the beam of all projections of a scan in counts, found from some projections. None if there
    are too few projections.

    Args:
        read: the detector rows that are read.
        references: darks and flats of these rows, binned.
    """
    if views.size < _LEAST_VIEWS:
        return None
    references, settings = replace(references, dynamic=None), replace(settings, air="none")
    in_shadow, first = np.zeros(references.dark.shape, np.bool_), read.start
    foreign = in_shadow[:, 0].copy()
    views = spread(views, SHADOW_VIEWS)
    for start in range(0, len(in_shadow), _BAND):
        rows = slice(max(0, start - SHADOW_REACH), min(len(in_shadow), start + _BAND + SHADOW_REACH))
        read = slice(first + rows.start * binning, first + rows.stop * binning)
        data = np.nan_to_num(read_binned(source, views, read, binning))
        transmission = survey(references.rows(rows), settings).transmission(data, views.astype(np.float64), views).data
        in_shadow[start : start + _BAND] = shadowed(transmission, settings.floor)[start - rows.start :][:_BAND]
        foreign[rows] |= foreign_rows(transmission, source.table.angles[views])
    return np.zeros_like(in_shadow) if in_shadow.all() else in_shadow, foreign


def shadow_on_lines(source: ScanSource, views: NDArray[np.int64], read: slice, binning: int) -> Shadow | None:
    """Like `shadow_on_counts`, but for line integrals. Objects that stand still in all projections are not visible in
    line integrals.
    """
    if views.size < SHADOW_VIEWS:
        return None
    sampled_views = spread(views, SHADOW_VIEWS)
    lines = LinesPlan.of(np.inf).transmission(
        read_binned(source, sampled_views, read, binning), sampled_views.astype(np.float64), sampled_views
    )
    foreign = foreign_rows(np.exp(-lines.data), source.table.angles[sampled_views])
    return np.zeros(lines.data.shape[1:], np.bool_), foreign


_PHOTONS = 1e-3, 1e12  # photons in a pixel of the open beam; limits far beyond the range of any detector
_TRANSFER_FRAMES, _TRANSFER_ROWS = 16, 64  # more projections do not make the gain more accurate, and take time to read


def photons_of(scan: SelectedScan, references: References) -> Photons | None:
    """Photon statistics of the (binned) pixels of a scan; None if line integrals are computed with logarithms.

    The gain is the value in the selection, or follows from the photon transfer of the largest group of flats. The
    readout noise follows from the largest group of darks.

    Raises:
        ConfigError: photon statistics were requested, but the flats do not determine the gain. Also if the given gain
            means more or fewer photons in the open beam than any detector can count.
    """
    selection = scan.selection
    model = selection.step(Preparation)
    if model.noise == "log":
        return None
    source, binning, rows = scan.source, selection.binning, selection.detector_rows
    first = rows.start + max(0, (rows.stop - rows.start - _TRANSFER_ROWS * binning) // 2 // binning * binning)
    middle = slice(first, min(first + _TRANSFER_ROWS * binning, rows.stop))
    spoilt = spoilt_frames(source, not model.uses_flags)
    flats, darks = (
        read_binned(source, np.setdiff1d(max(groups, key=len), spoilt)[:_TRANSFER_FRAMES], middle, binning)
        for groups in (scan.evidence.used_references.flats, scan.evidence.used_references.darks)
    )
    if model.gain is not None:  # one count of a mean over n pixels stands for n times as many photons
        n_photons = _counts_in_flats(references) * binning**2 / model.gain
        low, high = _PHOTONS
        if not low <= n_photons <= high:
            raise ConfigError(
                f"Give --gain in counts per photon, or omit --gain: --gain {model.gain:g} would mean {n_photons:.3g} "
                f"photons per pixel in the open beam of {source.path}; expected {low:g} to {high:g}."
            )
        variance = float(np.median(darks.var(axis=0, ddof=1))) if len(darks) > 1 else 0.0
        photons = Photons(model.gain / binning**2, variance)
    else:
        try:
            photons = Photons(*photon_transfer(flats, darks if len(darks) > 1 else None))
        except ValueError as error:
            if model.noise == "auto":
                return None
            raise ConfigError(
                "--noise counts needs the counts per photon. Give them with --gain COUNTS, because they could not be "
                f"found in {source.path}: {error}."
            ) from error
    # one count of a mean over n frames also stands for n times as many photons; flats and darks are single frames
    photons = Photons(photons.gain / source.frames_per_view, photons.variance / source.frames_per_view)
    if model.noise == "auto" and not photons_in_flats(references, photons) < FEW_PHOTONS:
        return None
    return photons


def photons_in_flats(references: References, photons: Photons) -> float:
    """Photons per pixel in the open beam: the median of the flats over the pixels in the beam, see `lit_places`."""
    return _counts_in_flats(references) / photons.gain


def _counts_in_flats(references: References) -> float:
    intensity = references.flats[0][1] - references.dark
    return float(np.median(intensity[exposed] if (exposed := lit_places(intensity)).any() else intensity))


def noise_sentence(references: References, photons: Photons | None) -> str:
    """A sentence that says how counts are converted to line integrals; empty if they are converted with logarithms."""
    if photons is None:
        return ""
    n_photons, readout = photons_in_flats(references, photons), photons.variance**0.5
    return (
        f"Photon statistics are used (--noise counts): {n_photons:.3g} photons per pixel in the open beam, "
        f"{photons.gain:.3g} counts per photon, readout noise {readout:.3g} counts"
    )
