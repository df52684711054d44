"""The views of scans of one sample at several energies as one set, and the table of spectra that they need."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in
from beamline.core.machine import free_memory
from beamline.core.sinks import Warn
from beamline.core.text import size
from beamline.projections.prepare import prepare_projections
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection, cone_of, rows_of
from beamline.reconstruct.slabs import SHARE
from beamline.storage.readers.open import SourceOptions
from recon.base.geometry import Geometry
from recon.base.volume import Grid
from recon.energy_fit import EnergyViews
from recon.voxels.displacement import measured_unmagnified, unmagnified

_COPIES = 8  # of all line integrals: of the scans, joined, as lines and of a subset; with a weight each
_PIXELS_ALIKE = 0.1  # pixel sizes of two scans may differ by this share: views are interpolated to those of the first
_ARCS_ALIKE = 0.01  # arcs of two scans may differ by this share of the larger one


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
        """[material], between the energies of the table. ConfigError outside of them."""
        if not self.energies[0] <= energy_kev <= self.energies[-1]:
            raise ConfigError(
                f"{self.path} has energies from {self.energies[0]:g} to {self.energies[-1]:g} keV; a scan was made at "
                f"{energy_kev:g} keV. Nothing was written."
            )
        return np.array([np.interp(energy_kev, self.energies, column) for column in self.attenuation.T])

    def states(self, names: Sequence[str]) -> tuple[int, int] | None:
        """Indices of two materials that are two states of the same one, by their names; None without names.

        Raises:
            ConfigError: these are not the names of two materials.
        """
        if not names:
            return None
        if len(set(names)) != 2 or len(names) != 2 or not set(names) <= set(self.names):
            raise ConfigError(
                f"--states {','.join(names)}: expected two of the materials {', '.join(self.names)} of {self.path}. "
                "Nothing was written."
            )
        return self.names.index(names[0]), self.names.index(names[1])


def read_spectra(path: Path) -> Spectra:
    """A CSV table: `energy_kev` and the names of materials in the first line, keV and 1/mm below.

    Raises:
        DataError: the file cannot be read, or is no such table.
    """
    try:
        lines = [line for line in csv.reader(text_in(path).splitlines(True)) if "".join(line).strip()]
    except (OSError, csv.Error) as error:
        raise DataError(f"{path} is no table of spectra ({error}). Expected {_TABLE}.") from error
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
    if any(not name.isprintable() or set(name) & set('/\\:*?"<>|') for name in names) or "" in names:
        raise DataError(f"{path}: names of materials are parts of file names; found {', '.join(map(repr, names))}.")
    if len({name.casefold() for name in names}) < len(names):
        raise DataError(f"{path}: names of materials must differ, in more than capitals; found {', '.join(names)}.")
    return Spectra(path, names, values[:, 0], values[:, 1:])


_TABLE = "a first line 'energy_kev,NAME,NAME,...', then a line of keV and 1/mm for each energy"


def energy_views(
    scans: Sequence[tuple[SourceOptions, Selection]],
    spectra: Spectra,
    warn: Warn,
    progress: Callable[[int, int], None],
    *,
    registered: bool = False,
) -> tuple[EnergyViews, PreparedProjections]:
    """The views of all scans, corrected, in the pixels of the first scan; and the first scan.

    The rotation axis of the first scan is used for the others, unless it is told. Views of another pixel size, as a
    lens gives it at another energy, are interpolated.

    Args:
        progress: called with the scans that are read, and all.
        registered: they will be registered, which cones cannot be.

    Raises:
        ConfigError: scans that do not fit together, energies that are missing or do not tell the materials apart, or
            too little memory. DataError: a scan cannot be read.
    """
    parts: list[PreparedProjections] = []
    middles: list[float] = []
    attenuation, axis_col = [], None
    for n, (source, selection) in enumerate(scans, 1):
        with ExitStack() as opened:
            scan = opened.enter_context(source.open())
            if scan.energy_kev is None:
                raise ConfigError(
                    f"{scan.path} does not state its energy (keV, instrument/beam/incident_energy of NXtomo), which "
                    "chooses the line of the spectra. Nothing was written."
                )
            if registered and cone_of(scan, selection) is not None:
                raise ConfigError(
                    f"--register: {scan.path} is of a cone, whose rays a shift of the sample turns. Leave it out. "
                    "Nothing was written."
                )
            attenuation.append(spectra.at(scan.energy_kev))
            chosen = replace(selection, axis_col=axis_col if selection.axis_col is None else selection.axis_col)
            held, alike = sum(part.projections.data.size for part in parts), len(scans) - len(parts)
            check = partial(_refuse_memory, len(spectra.names), held, alike)
            parts.append(prepare_projections(scan, chosen, warn, check=check))
            middles.append(((scan.shape[0] - 1) / 2 - rows_of(scan, chosen).start + 0.5) / chosen.binning - 0.5)
        axis_col = parts[0].axis_col
        progress(n, len(scans))
    _refuse_unlike(parts)
    seen = [_of_pixels(part, parts[0], row) for part, row in zip(parts, middles, strict=True)]
    return _joined(seen, attenuation), parts[0]


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


def _joined(parts: Sequence[PreparedProjections], attenuation: Sequence[NDArray[np.float64]]) -> EnergyViews:
    """The views of all scans; those of a scan with another rotation axis than the first are displaced."""
    weights = [part.ray_weights() for part in parts]
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
    geometry = parts[0].geometry
    for own in (part.geometry for part in parts[1:]):
        displaced = np.array([own.axis_col - geometry.axis_col, 0.0])
        geometry = geometry.followed_by(replace(own, shifts=own.shifts + displaced))
    energy = np.repeat(np.arange(len(parts)), [part.geometry.n_views for part in parts])
    try:
        return EnergyViews(data, geometry, energy, np.array(attenuation), weight)
    except ValueError as error:
        raise ConfigError(f"{error}. Nothing was written.") from error


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


def _refuse_memory(materials: int, held: int, alike: int, geometry: Geometry) -> None:
    """ConfigError where the fit would need too much memory; nothing of this scan is read yet.

    Args:
        held: rays of the scans before, which are in memory.
        alike: how many scans, this one and those after it, are taken to have the views of `geometry`.
    """
    grid = Grid.matching(geometry)
    rays = held + alike * geometry.n_views * math.prod(geometry.detector_shape)
    needs = 4 * (8 * materials * math.prod(grid.shape) + _COPIES * rays)
    may_use = SHARE * (free_memory() + 4 * held)
    if needs > may_use:
        raise ConfigError(
            f"{materials} materials of {grid.shape} voxels need {size(needs)} of memory; {size(may_use)} "
            "may be used. Give --rows, --views or --bin. Nothing was written."
        )
