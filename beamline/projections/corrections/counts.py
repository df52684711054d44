"""Counts: line integrals are logarithms, or carry the likelihood of the photons counted; which pixels are repaired."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from beamline.core.errors import ConfigError
from beamline.projections.corrections.preparation import Preparation
from recon.base.choices import FEW_PHOTONS

if TYPE_CHECKING:
    from beamline.projections.selection import Selection
    from beamline.storage.readers.base import ScanSource
    from beamline.storage.rules.references import ReferenceGroups
    from recon.prep.correct import References
    from recon.prep.counts import Photons

_PHOTONS = 1e-3, 1e12  # in a pixel of the open beam, far beyond any detector's on either side
_TRANSFER_FRAMES, _TRANSFER_ROWS = 16, 64  # more do not sharpen the gain, they only cost reading


def photons_of(
    source: ScanSource, used: ReferenceGroups, references: References, rows: slice, selection: Selection
) -> Photons | None:
    """How the pixels of a scan count photons, as they are read (binned); None: their logarithms are to be taken.

    The gain is that of the selection, or the photon transfer of the largest group of flats. The readout noise is that
    of the largest group of darks.

    Raises:
        ConfigError: counts are asked for, and the flats do not tell the gain. Or the gain given makes the photons of
            the open beam too many or too few for any detector.
    """
    from beamline.projections.read import read_binned, spoilt_frames
    from recon.prep.counts import Photons, photon_transfer

    model = selection.step(Preparation)
    if model.noise == "log":
        return None
    binning = selection.binning
    first = rows.start + max(0, (rows.stop - rows.start - _TRANSFER_ROWS * binning) // 2 // binning * binning)
    middle = slice(first, min(first + _TRANSFER_ROWS * binning, rows.stop))
    spoilt = spoilt_frames(source, not model.uses_flags)
    flats, darks = (
        read_binned(source, np.setdiff1d(max(groups, key=len), spoilt)[:_TRANSFER_FRAMES], middle, binning)
        for groups in (used.flats, used.darks)
    )
    if model.gain is not None:  # a mean of n pixels has n times as many photons a count
        light = _counts_of_light(references) * binning**2 / model.gain
        low, high = _PHOTONS
        if not low <= light <= high:
            raise ConfigError(
                f"--gain {model.gain:g} makes {light:.3g} photons a pixel of the open beam of {source.path}; "
                f"expected {low:g} to {high:g}. Give counts a photon, or leave --gain out."
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
                f"--noise counts: {source.path} does not tell the counts of a photon: {error}. Say --gain COUNTS."
            ) from error
    # A mean of n frames has n times as many photons a count, too; flats and darks are single frames.
    photons = Photons(photons.gain / source.frames_per_view, photons.variance / source.frames_per_view)
    if model.noise == "auto" and not light_of(references, photons) < FEW_PHOTONS:
        return None
    return photons


def light_of(references: References, photons: Photons) -> float:
    """Photons in a pixel of the open beam, the median of the flats."""
    return _counts_of_light(references) / photons.gain


def _counts_of_light(references: References) -> float:
    return float(np.median(references.flats[0][1] - references.dark))


def noise_sentence(references: References, photons: Photons | None) -> str:
    """How counts become line integrals, in words; empty where they are logarithms."""
    if photons is None:
        return ""
    light, readout = light_of(references, photons), photons.variance**0.5
    return (
        f"Photons are counted: {light:.3g} a pixel in the open beam, {photons.gain:.3g} counts each, readout "
        f"noise {readout:.3g} counts"
    )
