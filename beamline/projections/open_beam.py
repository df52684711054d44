"""The open beam of a scan: its darks and flats, ring current and photons, and what stands in the beam of all views."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError
from beamline.core.sinks import Warn
from beamline.core.text import count
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.counts import CountModel
from beamline.projections.corrections.defects import Defects
from beamline.projections.corrections.flags import Flags
from beamline.projections.corrections.flats import Flats
from beamline.projections.corrections.references import ReferenceCheck
from beamline.projections.read import (
    current_scale,
    read_binned,
    read_references,
    spoilt_frames,
    tell_damaged,
    use_current,
    with_dynamic_flats,
)
from beamline.projections.selection import Selection
from beamline.projections.step import StepDone
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import ReferenceGroups, groups_taken, reference_groups
from drivers.base.frame import FrameKind
from recon.base.arrays import Mask
from recon.base.choices import FEW_PHOTONS
from recon.prep.correct import Correction, CorrectionSettings, References
from recon.prep.counts import Photons, photon_transfer
from recon.prep.defects import SHADOW_REACH, shadowed

_PHOTONS = 1e-3, 1e12  # in a pixel of the open beam, far beyond any detector's on either side
_TRANSFER_FRAMES, _TRANSFER_ROWS = 16, 64  # more do not sharpen the gain, they only cost reading
_LEAST_VIEWS, _SHADOW_VIEWS, _BAND = 8, 16, 64  # for a shadow: views at least and at most, and rows at a time


@dataclass(frozen=True, eq=False)
class OpenBeam:
    """What divides the views of a scan of counts.

    Attributes:
        references: of the detector rows that are read, binned.
        settings: of the correction.
        photons: how pixels count photons; None: logarithms are taken.
        current_factor: float64 [frame], by how much its light grows to the median ring current; None: not asked for.
        n_references: darks and flats that the file had.
        used: those that are used.
        done: results of its steps, by name of the step.
    """

    references: References
    settings: CorrectionSettings
    photons: Photons | None
    current_factor: NDArray[np.float64] | None
    n_references: int
    used: ReferenceGroups
    done: dict[str, StepDone]

    @classmethod
    def of(cls, source: ScanSource, selection: Selection, read: slice, rows: slice, warn: Warn) -> OpenBeam:
        """The open beam by the reference frames that the file has; groups with a fault only if no other is left.

        Args:
            read: detector rows that are read.
            rows: those of them that are wanted.
            warn: is told of damaged frames, and of parts of the scan without flats of their own.

        Raises:
            ConfigError: counted photons without the counts of a photon, too few flats, or a file without ring current.
            DataError: references that cannot be used.
        """
        factor = current_scale(source) if use_current(selection) else None
        n, accepted = count_references(source), selection.step(ReferenceCheck).accepted
        used = groups_taken(source) if accepted else reference_groups(source).good()
        references = read_references(source, used, read, selection)
        if selection.step(Flats).fields == "dynamic":
            references = with_dynamic_flats(source, used, references, read, selection)
        tell_damaged(source, selection, np.concatenate([*used.darks, *used.flats]), warn)
        _tell_parts_without_flats(source, references, warn)
        photons = photons_of(source, used, references, rows, selection)
        defects = selection.step(Defects)
        settings = CorrectionSettings(
            defects.floor,
            defects.hot_threshold,
            defects.zinger_threshold,
            selection.step(Air).columns,
            selection.step(Air).sample_from,
        )
        flats, noise = _flats_said(source, references, factor), _noise_said(references, photons)
        recorded = {name: value if isinstance(value, float) else str(value) for name, value in asdict(settings).items()}
        del recorded["sample_from"]  # follows from --air
        done = {
            "defects": StepDone(parameters={f"correction_{name}": value for name, value in recorded.items()}),
            "flats": StepDone(flats, {"flats": flats or selection.step(Flats).fields}),
            "noise": StepDone(noise, {"noise": noise or "logarithms of counts"}),
        }
        return cls(references, settings, photons, factor, n, used, done)

    def correction(self, rows: slice, shadow: Mask | None) -> Correction:
        """The correction of some of the rows read, binned.

        Args:
            shadow: bool [row, col] of all rows read, what stands in the beam of all views; None: nothing.

        Raises:
            ValueError: references that cannot be used.
        """
        references, settings = self.references.rows(rows), self.settings
        found = Correction(references, settings, photons=self.photons)
        if shadow is None or not shadow[rows].any():
            return found
        return Correction(references, settings, found.masked | shadow[rows], self.photons)

    def shadow(self, source: ScanSource, views: NDArray[np.int64], first: int, binning: int) -> Mask | None:
        """bool [row, col], what stands in the beam of all views, by some of these; None: they are too few to tell.

        Args:
            first: the detector row at which the rows read begin.
        """
        if views.size < _LEAST_VIEWS:
            return None
        references, settings = replace(self.references, dynamic=None), replace(self.settings, air="none")
        found = np.zeros(references.dark.shape, np.bool_)
        views = views[np.linspace(0, views.size - 1, min(views.size, _SHADOW_VIEWS)).astype(int)]
        for start in range(0, len(found), _BAND):
            rows = slice(max(0, start - SHADOW_REACH), min(len(found), start + _BAND + SHADOW_REACH))
            read = slice(first + rows.start * binning, first + rows.stop * binning)
            data = np.nan_to_num(read_binned(source, views, read, binning))
            light = Correction(references.rows(rows), settings).transmission(data, views.astype(np.float64)).data
            found[start : start + _BAND] = shadowed(light, settings.floor)[start - rows.start :][:_BAND]
        return np.zeros_like(found) if found.all() else found


def count_references(source: ScanSource) -> int:
    """Darks and flats that the file has so far."""
    return int(np.isin(source.image_key, (FrameKind.DARK, FrameKind.FLAT)).sum())


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
    wanted = selection.step(CountModel)
    if wanted.noise == "log":
        return None
    binning = selection.binning
    first = rows.start + max(0, (rows.stop - rows.start - _TRANSFER_ROWS * binning) // 2 // binning * binning)
    middle = slice(first, min(first + _TRANSFER_ROWS * binning, rows.stop))
    spoilt = spoilt_frames(source, not selection.step(Flags).used)
    flats, darks = (
        read_binned(source, np.setdiff1d(max(groups, key=len), spoilt)[:_TRANSFER_FRAMES], middle, binning)
        for groups in (used.flats, used.darks)
    )
    if wanted.gain is not None:  # a mean of n pixels has n times as many photons a count
        light = _counts_of_light(references) * binning**2 / wanted.gain
        low, high = _PHOTONS
        if not low <= light <= high:
            raise ConfigError(
                f"--gain {wanted.gain:g} makes {light:.3g} photons a pixel of the open beam of {source.path}; "
                f"expected {low:g} to {high:g}. Give counts a photon, or leave --gain out."
            )
        variance = float(np.median(darks.var(axis=0, ddof=1))) if len(darks) > 1 else 0.0
        found = Photons(wanted.gain / binning**2, variance)
    else:
        try:
            found = Photons(*photon_transfer(flats, darks if len(darks) > 1 else None))
        except ValueError as error:
            if wanted.noise == "auto":
                return None
            raise ConfigError(
                f"--noise counts: {source.path} does not tell the counts of a photon: {error}. Say --gain COUNTS."
            ) from error
    if wanted.noise == "auto" and not light_of(references, found) < FEW_PHOTONS:
        return None
    return found


def light_of(references: References, photons: Photons) -> float:
    """Photons in a pixel of the open beam, the median of the flats."""
    return _counts_of_light(references) / photons.gain


def _counts_of_light(references: References) -> float:
    return float(np.median(references.flats[0][1] - references.dark))


def _flats_said(source: ScanSource, references: References, current_factor: NDArray[np.float64] | None) -> str:
    """What was done about changes of the beam, in words; empty where nothing was asked."""
    said = []
    if current_factor is not None:
        currents = 1 / current_factor[source.image_key == FrameKind.PROJECTION]
        said.append(
            f"Ring current of the views: {currents.min():.3f} to {currents.max():.3f} times its median; corrected."
        )
    if references.dynamic is not None:
        n = len(references.dynamic.components)
        said.append(
            f"Flats: {count(n, 'component')} of their changes, weighed for each view (dynamic)."
            if n
            else "Flats: they do not differ by more than noise; their mean is used."
        )
    return " ".join(said)


def _noise_said(references: References, photons: Photons | None) -> str:
    """How counts become line integrals, in words; empty where they are logarithms."""
    if photons is None:
        return ""
    light, readout = light_of(references, photons), photons.variance**0.5
    return (
        f"Photons are counted: {light:.3g} a pixel in the open beam, {photons.gain:.3g} counts each, readout "
        f"noise {readout:.3g} counts"
    )


def _tell_parts_without_flats(source: ScanSource, references: References, warn: Warn) -> None:
    """A warning for each part of the scan whose views are corrected by the flats of another part."""
    starts = source.part_starts
    flats = [position for position, _ in references.flats]
    for start, end in zip(starts, [*starts[1:], source.image_key.size], strict=True):
        has_views = (source.image_key[start:end] == FrameKind.PROJECTION).any()
        if has_views and not any(start <= position < end for position in flats):
            warn(
                f"Frames {start}-{end - 1}, a part of the scan, have no flats of their own that can be used. The "
                f"nearest flats of another part correct their views, though the beam may have changed."
            )
