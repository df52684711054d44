"""Open beam of a scan: darks and flats, ring current, photon statistics, and objects that stand in the beam of all
projections.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.core.sinks import Warn
from beamline.monitor.evidence import lit_places
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import CountsStep
from beamline.projections.read import read_binned, spoilt_frames, tell_damaged
from beamline.projections.references import (
    flats_sentence,
    light_scale,
    read_references,
    warn_of_parts_without_flats,
    with_dynamic_flats,
)
from beamline.projections.registry import in_order
from beamline.projections.selection import ScanSelection
from beamline.projections.step import StepDone
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.evidence import ScanEvidence
from recon.base.arrays import Mask
from recon.base.choices import FEW_PHOTONS
from recon.base.views import spread
from recon.prep.counts import Photons, photon_transfer
from recon.prep.counts_plan import CorrectionSettings, survey
from recon.prep.lines_plan import LinesPlan
from recon.prep.references import SHADOW_REACH, References, shadowed
from recon.prep.unmeasured import foreign_rows

# for an object in the beam: fewest and most projections that are examined, and rows at a time
_LEAST_VIEWS, SHADOW_VIEWS, _BAND = 8, 16, 64

# bool [row, col], objects in the beam of all projections; bool [row], rows in which objects other than the sample come
# and go
# sample (`foreign_rows`).
Shadow = tuple[Mask, Mask]


@dataclass(frozen=True, eq=False)
class OpenBeam:
    """The open beam by which the projections of a scan in counts are divided.

    Attributes:
        references: of the detector rows that are read, binned.
        settings: of the correction.
        photons: how pixels count photons; None: logarithms are taken.
        light: float64 [frame], factor to the usual exposure and, if asked for, to the median ring current; None: 1
            for all.
        done: what was done about flats, defects and noise, by these names.
    """

    references: References
    settings: CorrectionSettings
    photons: Photons | None
    light: NDArray[np.float64] | None
    done: dict[str, StepDone]

    @classmethod
    def of(cls, scan: ScanEvidence, selection: ScanSelection, read: slice, warn: Warn) -> OpenBeam:
        """The open beam from the reference frames in the file; a faulty group is used only if there is no other.

        Args:
            read: the detector rows to read.
            warn: function that gets sentences on damaged frames, on zingers, and on parts of the scan without flats.

        Raises:
            ConfigError: counted photons without the counts of a photon, too few flats, or a file without ring
                current.
            DataError: references that cannot be used.
        """
        asked = selection.step(Preparation)
        alike = not (asked.by_current or scan.views_differ)
        light = None if alike else light_scale(scan, asked.by_current)
        references = read_references(scan, read, selection, warn)
        if asked.flat_fields == "dynamic":
            references = with_dynamic_flats(scan, references, read, selection)
        tell_damaged(scan.source, selection, np.concatenate([*scan.used.darks, *scan.used.flats]), warn)
        warn_of_parts_without_flats(scan, references, warn)
        photons = photons_of(scan, references, selection)
        settings = CorrectionSettings()
        for step in in_order(selection):
            settings = step.settings(settings) if isinstance(step, CountsStep) else settings
        flats, noise = flats_sentence(scan, references, asked.by_current), noise_sentence(references, photons)
        recorded = {name: value if isinstance(value, float) else str(value) for name, value in asdict(settings).items()}
        del recorded["sample_from"]  # follows from --air
        done = {
            "defects": StepDone(parameters={f"correction_{name}": value for name, value in recorded.items()}),
            "flats": StepDone(flats, {"flats": flats or asked.flat_fields}),
            "noise": StepDone(noise, {"noise": noise or "logarithms of counts"}),
        }
        return cls(references, settings, photons, light, done)

    def shadow(self, source: ScanSource, views: NDArray[np.int64], first: int, binning: int) -> Shadow | None:
        """Objects in the beam of all projections, found in some of these; None if they are too few.

        Args:
            first: the detector row at which the rows read begin.
        """
        if views.size < _LEAST_VIEWS:
            return None
        references, settings = replace(self.references, dynamic=None), replace(self.settings, air="none")
        in_shadow = np.zeros(references.dark.shape, np.bool_)
        foreign = in_shadow[:, 0].copy()
        views = spread(views, SHADOW_VIEWS)
        for start in range(0, len(in_shadow), _BAND):
            rows = slice(max(0, start - SHADOW_REACH), min(len(in_shadow), start + _BAND + SHADOW_REACH))
            read = slice(first + rows.start * binning, first + rows.stop * binning)
            data = np.nan_to_num(read_binned(source, views, read, binning))
            light = survey(references.rows(rows), settings).transmission(data, views.astype(np.float64), views).data
            in_shadow[start : start + _BAND] = shadowed(light, settings.floor)[start - rows.start :][:_BAND]
            foreign[rows] |= foreign_rows(light, source.table.angles[views])
        return np.zeros_like(in_shadow) if in_shadow.all() else in_shadow, foreign


def foreign_to_lines(source: ScanSource, views: NDArray[np.int64], read: slice, binning: int) -> Shadow | None:
    """As `OpenBeam.shadow`, for line integrals, which do not show objects that stand still in all projections."""
    if views.size < SHADOW_VIEWS:
        return None
    some = spread(views, SHADOW_VIEWS)
    lines = LinesPlan.of(np.inf).transmission(read_binned(source, some, read, binning), some.astype(np.float64), some)
    foreign = foreign_rows(np.exp(-lines.data), source.table.angles[some])
    return np.zeros(lines.data.shape[1:], np.bool_), foreign


_PHOTONS = 1e-3, 1e12  # in a pixel of the open beam, far beyond any detector's range on either side
_TRANSFER_FRAMES, _TRANSFER_ROWS = 16, 64  # more do not make the gain more accurate, they only take time to read


def photons_of(scan: ScanEvidence, references: References, selection: ScanSelection) -> Photons | None:
    """Photon statistics of the (binned) pixels of a scan; None if logarithms are to be taken.

    The gain is that of the selection, or from the photon transfer of the largest group of flats. The readout noise
    is that of the largest group of darks.

    Raises:
        ConfigError: photon statistics were requested but the flats do not determine the gain; or the given gain means a
            number of photons in the open beam that is too large or too small for any detector.
    """
    model = selection.step(Preparation)
    if model.noise == "log":
        return None
    source, binning, rows = scan.source, selection.binning, selection.detector_rows
    first = rows.start + max(0, (rows.stop - rows.start - _TRANSFER_ROWS * binning) // 2 // binning * binning)
    middle = slice(first, min(first + _TRANSFER_ROWS * binning, rows.stop))
    spoilt = spoilt_frames(source, not model.uses_flags)
    flats, darks = (
        read_binned(source, np.setdiff1d(max(groups, key=len), spoilt)[:_TRANSFER_FRAMES], middle, binning)
        for groups in (scan.used.flats, scan.used.darks)
    )
    if model.gain is not None:  # a mean of n pixels has n times as many photons per count
        light = _counts_of_light(references) * binning**2 / model.gain
        low, high = _PHOTONS
        if not low <= light <= high:
            raise ConfigError(
                f"Give --gain in counts per photon, or omit it: --gain {model.gain:g} would mean {light:.3g} "
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
                "Give --gain COUNTS for --noise counts, because the counts per photon could not be found "
                f"in {source.path}: {error}."
            ) from error
    # A mean of n frames also has n times as many photons per count; flats and darks are single frames.
    photons = Photons(photons.gain / source.frames_per_view, photons.variance / source.frames_per_view)
    if model.noise == "auto" and not light_of(references, photons) < FEW_PHOTONS:
        return None
    return photons


def light_of(references: References, photons: Photons) -> float:
    """Photons per pixel in the open beam, the median of the flats inside the beam, see `lit_places`."""
    return _counts_of_light(references) / photons.gain


def _counts_of_light(references: References) -> float:
    light = references.flats[0][1] - references.dark
    return float(np.median(light[lit] if (lit := lit_places(light)).any() else light))


def noise_sentence(references: References, photons: Photons | None) -> str:
    """How counts are converted to line integrals, in words; empty if with logarithms."""
    if photons is None:
        return ""
    light, readout = light_of(references, photons), photons.variance**0.5
    return (
        f"Photon statistics are used (--noise counts): {light:.3g} photons per pixel in the open beam, "
        f"{photons.gain:.3g} counts per photon, readout noise {readout:.3g} counts"
    )
