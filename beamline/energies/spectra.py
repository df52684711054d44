"""Spectra: what pure materials attenuate, by a table."""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in


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
