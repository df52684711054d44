"""The open beam of a scan: its darks and flats, ring current and photons, and what stands in the beam of all views."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.sinks import Warn
from beamline.projections.corrections.air import Air
from beamline.projections.corrections.counts import noise_sentence, photons_of
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.corrections.references import (
    flats_sentence,
    read_references,
    view_scale,
    warn_of_parts_without_flats,
    with_dynamic_flats,
)
from beamline.projections.read import read_binned, tell_damaged
from beamline.projections.selection import Selection
from beamline.projections.step import StepDone
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import ReferenceGroups, groups_taken, reference_groups
from drivers.base.frame import FrameKind
from recon.base.arrays import Mask
from recon.prep.correct import Correction, CorrectionSettings, References
from recon.prep.counts import Photons
from recon.prep.defects import SHADOW_REACH, shadowed

_LEAST_VIEWS, _SHADOW_VIEWS, _BAND = 8, 16, 64  # for a shadow: views at least and at most, and rows at a time


@dataclass(frozen=True, eq=False)
class OpenBeam:
    """What divides the views of a scan of counts.

    Attributes:
        references: of the detector rows that are read, binned.
        settings: of the correction.
        photons: how pixels count photons; None: logarithms are taken.
        light: float64 [frame], by how much that of a view grows to the usual exposure and, where it is asked for, the
            median ring current; None: all views are alike.
        n_references: darks and flats that the file had.
        used: those that are used.
        done: what flats, defects and noise came to, by these names.
    """

    references: References
    settings: CorrectionSettings
    photons: Photons | None
    light: NDArray[np.float64] | None
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
        asked = selection.step(Preparation)
        light, n = view_scale(source, asked.by_current), count_references(source)
        used = groups_taken(source) if asked.accepted else reference_groups(source).good()
        references = read_references(source, used, read, selection)
        if asked.flat_fields == "dynamic":
            references = with_dynamic_flats(source, used, references, read, selection)
        tell_damaged(source, selection, np.concatenate([*used.darks, *used.flats]), warn)
        warn_of_parts_without_flats(source, references, warn)
        photons = photons_of(source, used, references, rows, selection)
        settings = CorrectionSettings(
            asked.floor,
            asked.hot_threshold,
            asked.zinger_threshold,
            selection.step(Air).columns,
            selection.step(Air).sample_from,
        )
        flats, noise = flats_sentence(source, references, asked.by_current), noise_sentence(references, photons)
        recorded = {name: value if isinstance(value, float) else str(value) for name, value in asdict(settings).items()}
        del recorded["sample_from"]  # follows from --air
        done = {
            "defects": StepDone(parameters={f"correction_{name}": value for name, value in recorded.items()}),
            "flats": StepDone(flats, {"flats": flats or asked.flat_fields}),
            "noise": StepDone(noise, {"noise": noise or "logarithms of counts"}),
        }
        return cls(references, settings, photons, light, n, used, done)

    def correction(self, rows: slice, shadow: Mask | None) -> Correction:
        """The correction of some of the rows read, binned.

        Args:
            shadow: bool [row, col] of all rows read, what stands in the beam of all views; None: nothing.

        Raises:
            ValueError: references that cannot be used.
        """
        references, settings = self.references.rows(rows), self.settings
        plain = Correction(references, settings, photons=self.photons)
        if shadow is None or not shadow[rows].any():
            return plain
        return Correction(references, settings, plain.masked | shadow[rows], self.photons)

    def shadow(self, source: ScanSource, views: NDArray[np.int64], first: int, binning: int) -> Mask | None:
        """bool [row, col], what stands in the beam of all views, by some of these; None: they are too few to tell.

        Args:
            first: the detector row at which the rows read begin.
        """
        if views.size < _LEAST_VIEWS:
            return None
        references, settings = replace(self.references, dynamic=None), replace(self.settings, air="none")
        in_shadow = np.zeros(references.dark.shape, np.bool_)
        views = views[np.linspace(0, views.size - 1, min(views.size, _SHADOW_VIEWS)).astype(int)]
        for start in range(0, len(in_shadow), _BAND):
            rows = slice(max(0, start - SHADOW_REACH), min(len(in_shadow), start + _BAND + SHADOW_REACH))
            read = slice(first + rows.start * binning, first + rows.stop * binning)
            data = np.nan_to_num(read_binned(source, views, read, binning))
            light = Correction(references.rows(rows), settings).transmission(data, views.astype(np.float64)).data
            in_shadow[start : start + _BAND] = shadowed(light, settings.floor)[start - rows.start :][:_BAND]
        return np.zeros_like(in_shadow) if in_shadow.all() else in_shadow


def count_references(source: ScanSource) -> int:
    """Darks and flats that the file has so far."""
    return int(np.isin(source.image_key, (FrameKind.DARK, FrameKind.FLAT)).sum())
