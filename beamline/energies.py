"""Scans of one sample at several energies: their spectra, and a source of views with the energy of each."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import Phases
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in
from beamline.core.sinks import Warn
from beamline.core.text import safe_name
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection, cone_of, rows_of
from beamline.reconstruct.option_rules import OF_ONE_VOLUME
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from recon.base.method import Energies, Method, volume_names_of
from recon.features.joint.energy_fit import EnergyViews, refuse_alike
from recon.features.joint.learnt_motion import register_energies
from recon.voxels.displacement import measured_unmagnified, unmagnified


@dataclass(frozen=True, eq=False)
class Spectra:
    """Attenuation of materials.

    Attributes:
        names: of the materials.
        energies: keV, [n], rising.
        attenuation: 1/mm of the pure material, [n, material].
    """

    path: Path
    names: tuple[str, ...]
    energies: NDArray[np.float64]
    attenuation: NDArray[np.float64]

    def at(self, energy_kev: float) -> NDArray[np.float64]:
        """Attenuation [material] in 1/mm, interpolated in energy. Raises ConfigError outside the table."""
        if not self.energies[0] <= energy_kev <= self.energies[-1]:
            raise ConfigError(
                f"{self.path} has energies from {self.energies[0]:g} to {self.energies[-1]:g} keV; a scan was made at "
                f"{energy_kev:g} keV. Nothing was written."
            )
        return np.array([np.interp(energy_kev, self.energies, column) for column in self.attenuation.T])


def read_spectra(path: Path) -> Spectra:
    """Read a CSV table: `energy_kev` and the names of materials in the first line, keV and 1/mm below.

    Raises:
        DataError: the file cannot be read, or is no such table.
    """
    try:
        lines = [line for line in csv.reader(text_in(path).splitlines(True)) if "".join(line).strip()]
    except (OSError, csv.Error) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise DataError(f"{path} is no table of spectra ({said}). Expected {_TABLE}.") from error
    head, *rest = lines or [[]]
    names = tuple(name.strip() for name in head[1:])
    if not rest or not names or head[0].strip() != "energy_kev":
        raise DataError(f"{path} is no table of spectra: it begins {','.join(head)[:80]!r}. Expected {_TABLE}.")
    values = np.empty((len(rest), len(head)))
    for number, line in enumerate(rest):
        try:
            values[number] = [float(cell) for _, cell in zip(head, line, strict=True)]
        except ValueError:
            text = ",".join(line)[:80]
            raise DataError(f"{path}: {text!r} are not {len(head)} numbers. Expected {_TABLE}.") from None
    values = values[np.argsort(values[:, 0])]
    if not np.isfinite(values).all() or (np.diff(values[:, 0]) == 0).any() or (values < 0).any():
        raise DataError(f"{path}: energies must differ, and all values be finite and 0 or more.")
    if any(name != safe_name(name) for name in names):
        raise DataError(f"{path}: names of materials are parts of file names; found {', '.join(map(repr, names))}.")
    if len({name.casefold() for name in names}) < len(names):
        raise DataError(f"{path}: names of materials must differ, in more than capitals; found {', '.join(names)}.")
    return Spectra(path, names, values[:, 0], values[:, 1:])


_TABLE = "a first line 'energy_kev,NAME,NAME,...', then a line of keV and 1/mm for each energy"


_PIXELS_ALIKE = 0.1  # pixel sizes of two scans may differ by this share: views are interpolated to those of the first
_ARCS_ALIKE = 0.01  # arcs of two scans may differ by this share of the larger one


@dataclass(frozen=True, eq=False)
class EnergyScans:
    """Scans of one sample, one at each energy: a source of views, where `SourceOptions` is that of a single scan.

    Attributes:
        scans: the first one's rotation axis is used for the others, unless it is told, and its facts are in the report.
        spectra: what pure materials attenuate.
        registered: find where the sample stood in each scan, and how the image is shifted and magnified; correct it.
    """

    scans: tuple[SourceOptions, ...]
    spectra: Spectra
    registered: bool = False

    @property
    def path(self) -> Path | str:
        """Path of the first scan."""
        return self.scans[0].path

    def open(self, *, follow: bool = False) -> ScanSource:
        """Open the first scan."""
        return self.scans[0].open(follow=follow)

    def refuse(self, method: Method, given: Collection[str]) -> None:
        """Raise ConfigError for a method of one scan, or of other materials, and for options of one volume."""
        if not method.traits.by_energy:
            raise ConfigError(f"{method.name} takes one scan. Choose another method. Nothing was read.")
        for name in (name for name in OF_ONE_VOLUME if name in given):
            raise ConfigError(
                f"--{name} does not go with several energies: {OF_ONE_VOLUME[name]}. Nothing was computed."
            )
        if volume_names_of(method) != self.spectra.names:
            raise ConfigError(
                f"{method.name} is of {', '.join(volume_names_of(method))}, {self.spectra.path} of "
                f"{', '.join(self.spectra.names)}: give it the same materials. Nothing was read."
            )

    def require_alike(self, selection: Selection) -> None:
        """Raise ConfigError as `attenuation_of`."""
        attenuation_of(self, selection)

    def prepare(
        self, selection: Selection, warn: Warn, check: Callable[[Geometry], object], phases: Phases | None
    ) -> PreparedProjections:
        """See `prepare_energies`."""
        return prepare_energies(self, selection, warn, check, phases)


def prepare_energies(
    scans: EnergyScans,
    selection: Selection,
    warn: Warn,
    check: Callable[[Geometry], object] = lambda geometry: None,
    phases: Phases | None = None,
) -> PreparedProjections:
    """`prepare_projections` of all scans: the views in the pixels of the first one, with their energies.

    The rotation axis of the first scan is used for the others, unless it is told. Views of another pixel size, as a
    lens gives it at another energy, are interpolated.

    Args:
        check: as of `prepare_projections`, of the geometry of each scan.

    Raises:
        ConfigError: scans that do not fit together, or energies that are missing or do not tell the materials apart.
            DataError: a scan cannot be read.
    """
    parts: list[PreparedProjections] = []
    middles: list[float] = []
    phases = phases or Phases()
    attenuation, axis_col = attenuation_of(scans, selection), None  # before any is corrected
    for each in scans.scans:
        with each.open() as scan:
            chosen = replace(selection, axis_col=axis_col if selection.axis_col is None else selection.axis_col)
            parts.append(prepare_projections(scan, chosen, warn, check=check, phases=phases))
            middles.append(((scan.shape[0] - 1) / 2 - rows_of(scan, chosen).start + 0.5) / chosen.binning - 0.5)
        axis_col = parts[0].axis_col
    _refuse_unlike(parts)
    seen = [_of_pixels(part, parts[0], row) for part, row in zip(parts, middles, strict=True)]
    joined = replace(_joined(seen, attenuation), recorded=_recorded(scans))
    del parts, seen  # copies of all line integrals
    if not scans.registered:
        return joined
    phases.enter("registration", "volumes")
    return _registered(joined, phases.progress)


def attenuation_of(scans: EnergyScans, selection: Selection) -> NDArray[np.float64]:
    """Attenuation [energy, material] in 1/mm at the energy of each scan; no frame is read.

    Raises:
        ConfigError: energies that are missing, not in the table, or do not tell the materials apart.
    """
    attenuation = []
    for each in scans.scans:
        with each.open() as scan:
            attenuation.append(_attenuation(scans, scan, selection))
    try:
        refuse_alike(np.array(attenuation))
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error
    return np.array(attenuation)


def _attenuation(scans: EnergyScans, scan: ScanSource, selection: Selection) -> NDArray[np.float64]:
    """[material] at the energy of a scan. ConfigError where it cannot be one of these scans."""
    if scan.energy_kev is None:
        raise ConfigError(
            f"{scan.path} does not state its energy (keV, instrument/beam/incident_energy of NXtomo), which chooses "
            "the line of the spectra. Nothing was written."
        )
    if scans.registered and cone_of(scan, selection) is not None:
        raise ConfigError(
            f"--register: {scan.path} is of a cone, whose rays a shift of the sample turns. Leave it out. Nothing was "
            "written."
        )
    return scans.spectra.at(scan.energy_kev)


def _recorded(scans: EnergyScans) -> dict[str, str]:
    return {"scans": ", ".join(str(Path(each.path).resolve()) for each in scans.scans)}


def _of_pixels(part: PreparedProjections, first: PreparedProjections, middle: float) -> PreparedProjections:
    """The views in the pixels of the first scan, magnified about the middle of the detector, whose row is `middle`."""
    own, pitch = part.geometry, first.geometry.pixel_pitch
    if (factor := pitch / own.pixel_pitch) == 1:
        return part
    centre, weight = (middle, (own.detector_shape[1] - 1) / 2), part.ray_weights()
    there = np.ones(part.projections.data.shape, np.bool_) if weight is None else weight > 0
    usual = there.astype(np.float32) if weight is None else weight
    shares = unmagnified(usual, factor, centre, order=1) * measured_unmagnified(there, factor, centre)
    data = unmagnified(np.where(there, part.projections.data, np.float32(0)), factor, centre)
    return replace(
        part,
        projections=replace(part.projections, data=data, weights=None),
        geometry=replace(own, pixel_pitch=pitch, shifts=own.shifts / factor),
        view_weights=None,
        measured=None,
        shares=shares,
        shares_of=None,
    )


def _joined(parts: Sequence[PreparedProjections], attenuation: NDArray[np.float64]) -> PreparedProjections:
    """The views of all scans; those of a scan with another rotation axis than the first are displaced."""
    first, weights = parts[0], [part.ray_weights() for part in parts]
    data = np.concatenate([part.projections.data for part in parts])
    weight = None
    if any(each is not None for each in weights):
        weight = np.concatenate(
            [
                np.broadcast_to(np.float32(1) if each is None else each, part.projections.data.shape)
                for each, part in zip(weights, parts, strict=True)
            ]
        ).astype(np.float32)
        data = np.where(weight > 0, data, np.float32(0))
    geometry = first.geometry
    for own in (part.geometry for part in parts[1:]):
        displaced = np.array([own.axis_col - geometry.axis_col, 0.0])
        geometry = geometry.followed_by(replace(own, shifts=own.shifts + displaced))
    energy = np.repeat(np.arange(len(parts)), [part.geometry.n_views for part in parts])
    views = EnergyViews(data, geometry, energy, attenuation, weight)
    corrected = [part.projections for part in parts]
    return _with_views(
        replace(
            first,
            projections=replace(
                first.projections,
                view_ids=np.concatenate([each.view_ids for each in corrected]),
                air=np.concatenate([each.air for each in corrected]),
                floored=float(np.mean([each.floored for each in corrected])),
                replaced=float(np.mean([each.replaced for each in corrected])),
                weights=None,
            ),
            n_projections=sum(part.n_projections for part in parts),
            left_out=sum(part.left_out for part in parts),
            energies=Energies(energy, views.cross_sections),
            held_out=None,
            held_out_ids=None,
            held_out_weights=None,
            view_weights=None,
            measured=None,
            shares_of=None,
        ),
        views,
    )


def _with_views(prepared: PreparedProjections, views: EnergyViews) -> PreparedProjections:
    projections = replace(prepared.projections, data=views.projections)
    return replace(prepared, projections=projections, geometry=views.geometry, shares=views.weight)


def views_of(prepared: PreparedProjections) -> EnergyViews:
    """The views of several energies in the form that `recon.fit_materials` expects."""
    assert prepared.energies is not None
    energies, data = prepared.energies, prepared.projections.data
    return EnergyViews(data, prepared.geometry, energies.of_view, energies.cross_sections, prepared.shares)


def _registered(prepared: PreparedProjections, progress: Callable[[int, int], None]) -> PreparedProjections:
    """The views corrected by where the sample stood in each scan, which the file records."""
    try:
        views, moves = register_energies(views_of(prepared), progress)
    except ValueError as error:
        raise ConfigError(f"--register: {error}. Nothing was written.") from error
    recorded = {**prepared.recorded, "displacements": np.array([astuple(move) for move in moves])}
    return replace(_with_views(prepared, views), recorded=recorded)


def _refuse_unlike(parts: Sequence[PreparedProjections]) -> None:
    """One geometry is of all views: they share detector, beam, and the motion of the stage in an exposure."""
    first = parts[0].geometry
    for n, own in enumerate((part.geometry for part in parts[1:]), 2):
        alike = math.isclose(own.pixel_pitch, first.pixel_pitch, rel_tol=0 if own.is_cone else _PIXELS_ALIKE)
        if (own.detector_shape, own.sod, own.sdd) != (first.detector_shape, first.sod, first.sdd) or not alike:
            raise ConfigError(
                f"The scans do not fit together: {first.detector_shape} pixels of {first.pixel_pitch:g} "
                f"{parts[0].length_unit}, and {own.detector_shape} of {own.pixel_pitch:g}. Nothing was written."
            )
        arcs, skews = (first.width.arc, own.width.arc), (first.skew, own.skew)
        if not all(math.isclose(*turns, rel_tol=_ARCS_ALIKE) for turns in (arcs, skews)):
            turned = [f"{math.degrees(g.width.arc):.3g}° and {math.degrees(g.skew):.2g}° a row" for g in (first, own)]
            raise ConfigError(
                f"The scans do not fit together: the stage turns {turned[0]} in an exposure of scan 1, and {turned[1]} "
                f"in one of scan {n}. Give an --exposure-arc that holds for all, or none. Nothing was written."
            )
    if parts[0].length_unit != "mm":
        raise ConfigError("The spectra are in 1/mm; give --pixel-size-um, as the scans do not state it.")
