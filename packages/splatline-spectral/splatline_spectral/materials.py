"""`beamline materials`: computes a volume of each material from scans at several energies."""

from __future__ import annotations

import csv
import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from numpy.typing import NDArray

from beamline.cli.options import json_option
from beamline.cli.terminal import answering
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import refuse_existing, text_in
from beamline.core.text import safe_name

_TABLE = "a first line 'energy_kev,NAME,NAME,...', then a line of keV and 1/mm for each energy"
_PIXELS_ALIKE = 0.1  # pixel sizes of two scans may differ by this fraction if the scans are registered
_ARCS_ALIKE = 0.01  # the arcs of an exposure may differ by this fraction of the larger one
_FILE = click.Path(path_type=Path, dir_okay=False)


@dataclass(frozen=True, eq=False)
class Spectra:
    """Attenuation of materials over energy.

    Attributes:
        energies: keV, [n], rising.
        attenuation: [n, material], attenuation of the pure material in 1/mm.
    """

    path: Path
    names: tuple[str, ...]
    energies: NDArray[np.float64]
    attenuation: NDArray[np.float64]

    def at(self, energy_kev: float | None, scan: Path) -> NDArray[np.float64]:
        """Attenuation [material] in 1/mm, interpolated in energy. Raises ConfigError if the energy is unknown, or
        outside of the table."""
        if energy_kev is None or not self.energies[0] <= energy_kev <= self.energies[-1]:
            stated = "not stated" if energy_kev is None else f"{energy_kev:g} keV"
            raise ConfigError(
                f"The energy of {scan} is {stated}; expected {self.energies[0]:g} to {self.energies[-1]:g} keV, the "
                f"range of {self.path}. Nothing was written."
            )
        return np.array([np.interp(energy_kev, self.energies, column) for column in self.attenuation.T])


def read_spectra(path: Path) -> Spectra:
    """Read a CSV table: the first line is `energy_kev` and the names of materials, the next lines are keV and 1/mm.

    Raises:
        DataError: the file cannot be read, or is not such a table.
    """
    try:
        head, *rest = (line for line in csv.reader(text_in(path).splitlines(True)) if "".join(line).strip())
        names = tuple(name.strip() for name in head[1:])
        values = np.array([[float(cell) for _, cell in zip(head, line, strict=True)] for line in rest])
        values = values[np.argsort(values[:, 0])]
    except (OSError, csv.Error, ValueError, IndexError) as error:
        raise DataError(f"{path} cannot be read as a table of spectra ({error}). Expected {_TABLE}.") from error
    if head[0].strip() != "energy_kev" or not names or len({name.casefold() for name in names}) < len(names):
        raise DataError(
            f"{path} begins with {','.join(head)[:80]!r}. Expected {_TABLE}. Each NAME may occur only once; capital "
            "and small letters count as equal."
        )
    if not np.isfinite(values).all() or (np.diff(values[:, 0]) == 0).any() or (values < 0).any():
        raise DataError(f"{path}: energies must differ, and all values must be finite and 0 or more.")
    if any(name != safe_name(name) for name in names):
        raise DataError(
            f"{path}: names of materials become parts of file names and must be valid there; found "
            f"{', '.join(map(repr, names))}."
        )
    return Spectra(path, names, values[:, 0], values[:, 1:])


@click.command()
@click.argument("files", metavar="SCAN...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--spectra", type=_FILE, required=True,
              help="CSV table: first line energy_kev and names of materials, then keV and 1/mm.")  # fmt: skip
@click.option("-o", "--output", metavar="PATH.h5", type=_FILE, required=True,
              help="Where to write: one file for each material, PATH_NAME.h5.")  # fmt: skip
@click.option("--register", is_flag=True,
              help="Find and correct the motion of the sample between the scans, and the magnification of each "
                  "scan.")  # fmt: skip
@click.option("--states", metavar="NAME,NAME",
              help=(
                  "Names of two materials that are states of one material, such as charged and discharged. The fit "
                  "then keeps the sum of their densities, and makes the fraction of each state smooth in space."
              ))  # fmt: skip
@click.option(
    "--axis", type=float, metavar="COL", help="Column of the rotation axis. Default: found in the first scan."
)
@click.option(
    "--rows",
    type=click.IntRange(0),
    nargs=2,
    metavar="FIRST END",
    help="First detector row to use, and the row after the last row to use. Default: all rows.",
)
@click.option("--bin", "binning", type=click.IntRange(1), default=1, show_default=True, help="Average N x N pixels.")
@json_option
def materials(files: tuple[Path, ...], spectra: Path, output: Path, as_json: bool, **values: Any) -> None:
    """Compute a volume of each material from scans at several energies. A voxel holds the fraction of the material.

    Each SCAN file must state its energy; you may give the folder of a series (`scan.energies`) in place of its scans.
    Few projections at each energy are enough, because one fit uses all of them. Take different angles at different
    energies. Give --register if the sample moved, or the magnification changed, between the scans.

    Example: beamline materials E1.h5 E2.h5 --spectra mu.csv -o out.h5
    """
    import recon
    from beamline.api import Selection
    from beamline.core.quantities import VoxelKind
    from beamline.scan.series import scans_of
    from beamline.storage.volumes.base import bare_record
    from beamline.storage.volumes.files import write_volume

    table = read_spectra(spectra)
    outputs = [output.with_name(f"{output.stem}_{name}{output.suffix}") for name in table.names]
    states = [table.names.index(name) for name in (values["states"] or "").split(",") if name in table.names]
    if values["states"] and len(states) != 2:
        raise click.UsageError(f"--states {values['states']}: expected two of {', '.join(table.names)}.")
    with answering(as_json) as answer:
        for path in outputs:
            refuse_existing(path)
        scans = scans_of(files, answer.warn)
        selection = Selection(rows=values["rows"], binning=values["binning"], axis_col=values["axis"])
        try:
            views = joined(scans, table, selection, values["register"], answer.warn)
            moves: Sequence[Any] = ()
            if values["register"]:
                views, moves = recon.register_energies(views, answer.counting("registering the scans"))
            fitted = recon.fit_materials(views)
            if states:
                fitted = recon.fit_share(views, fitted, (states[0], states[1]))
        except ValueError as error:
            raise ConfigError(f"The scans cannot be fitted: {error}. Nothing was written.") from error
        for name, path, densities in zip(table.names, outputs, fitted.densities, strict=True):
            record = replace(
                bare_record(scans[0], densities), volume=recon.Volume(densities, fitted.grid), length_unit="mm",
                raw_file=str(scans[0].resolve()), title=f"volume fraction of {name}", kind=VoxelKind.SHARE,
                time=answer.clock.now(),
                parameters={
                    "method": "materials", "material": name, "scans": ", ".join(str(each.resolve()) for each in scans),
                    "tv_weights": fitted.weights, "displacements": np.array([astuple(move) for move in moves]),
                },
                metrics={"residual": fitted.residual},
            )  # fmt: skip
            write_volume(path, record)
        facts = {"outputs": dict(zip(table.names, outputs, strict=True)), "residual": fitted.residual}
        written = [f"{name:<12}{path}" for name, path in zip(table.names, outputs, strict=True)]
        answer.done(facts, *written, *map(_move, moves))


def _move(move: Any) -> str:
    """A line for the terminal on the displacement of the sample in a scan."""
    shifts = ", ".join(f"{1e3 * getattr(move, axis):+.2f}" for axis in "xyz")
    return (
        f"displaced   {shifts} µm along x, y, z, turned {math.degrees(move.turn):+.3f}°, magnified "
        f"{move.magnification:.4f}"
    )


def joined(
    scans: Sequence[Path], spectra: Spectra, selection: Any, registered: bool, warn: Callable[[str], None]
) -> Any:
    """The corrected projections of all scans as `recon.EnergyViews`. The axis of the first scan is used for all.

    Raises:
        ConfigError: the scans do not fit together, or an energy is not in the table. DataError: a scan cannot be read.
        ValueError: the energies do not distinguish the materials.
    """
    import recon
    from beamline.projections.prepare import prepare_projections
    from beamline.projections.views import select
    from beamline.storage.readers.open import open_scan

    attenuation, parts = [], []
    for path in scans:
        with open_scan(path) as scan:
            attenuation.append(spectra.at(scan.energy_kev, path))
    for path in scans:
        with open_scan(path) as scan:
            parts.append(prepare_projections(select(scan, selection), warn))
        selection = replace(selection, axis_col=parts[0].origin.axis_col)
    if parts[0].origin.length_unit != "mm":
        raise ConfigError("The scans must state the pixel size, because the spectra are in 1/mm. Nothing was written.")
    first, weights = parts[0].geometry, [part.views.seen.weights for part in parts]
    geometry = first
    for number, own in enumerate((part.geometry for part in parts[1:]), 2):
        _refuse_unlike(first, own, number, _PIXELS_ALIKE if registered else 1e-6)
        displaced = np.array([own.axis_col - first.axis_col, 0.0])
        own = replace(own, pixel_pitch=first.pixel_pitch, shifts=own.shifts + displaced)
        geometry = geometry.followed_by(own)
    data = np.concatenate([part.seen.data for part in parts])
    weight = None
    if any(each is not None for each in weights):
        shapes = [part.seen.data.shape for part in parts]
        filled = [np.ones(shape) if each is None else each[...] for each, shape in zip(weights, shapes, strict=True)]
        broad = [np.broadcast_to(each, shape) for each, shape in zip(filled, shapes, strict=True)]
        weight = np.concatenate(broad).astype(np.float32)
        data = np.where(weight > 0, data, np.float32(0))
    energy = np.repeat(np.arange(len(parts)), [part.geometry.n_views for part in parts])
    return recon.EnergyViews(data, geometry, energy, np.array(attenuation), weight)


def _refuse_unlike(first: Any, own: Any, number: int, pixels: float) -> None:
    """Raise ConfigError if two scans differ in detector, beam, or the motion of the stage during an exposure."""
    alike = math.isclose(own.pixel_pitch, first.pixel_pitch, rel_tol=0 if own.is_cone else pixels)
    turns = ((first.width.arc, own.width.arc), (first.skew, own.skew))
    alike &= all(math.isclose(*turn, rel_tol=_ARCS_ALIKE) for turn in turns)
    if (own.detector_shape, own.sod, own.sdd) != (first.detector_shape, first.sod, first.sdd) or not alike:
        raise ConfigError(
            f"Scan {number} does not fit scan 1: it has {own.detector_shape} pixels of {own.pixel_pitch:g} mm, and "
            f"its stage turns by {math.degrees(own.width.arc):.3g}° in an exposure. Scan 1 has {first.detector_shape} "
            f"pixels of {first.pixel_pitch:g} mm, and its stage turns by {math.degrees(first.width.arc):.3g}°. If only "
            "the pixel sizes differ, by up to a tenth, give --register."
        )
