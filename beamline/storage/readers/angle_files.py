"""Angles in files of their own: a text, a column of a table, an array of NumPy, or a list in an HDF5 file or Zarr."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.files import text_in
from beamline.core.text import NUMBER
from beamline.plan.plan import from_text
from beamline.storage import hdf5
from beamline.storage.datasets import ANGLE_UNITS, DEGREE, factor_of
from beamline.storage.readers.arrays import holds_arrays
from beamline.storage.readers.stacks import angles_at

Angles = Path | str | ArrayLike
"""A file, or FILE::NAME of a column or a dataset, in degrees unless it states a unit; or an array in radians."""
_ANGLE = re.compile(r"angle|theta|rotation|omega|phi|degree|\bdeg\b|°", re.IGNORECASE)
_UNIT = re.compile(r"[\[(]([^\])]+)[\])]\s*$|[ _](deg|degrees?|m?rad|radians?|°)\s*$", re.IGNORECASE)  # of a column
_VALUE = re.compile(rf"[-+]?({NUMBER}|\d+,\d+|nan|inf(inity)?)", re.IGNORECASE)


def load_angles(angles: Angles, unit: str | None = None) -> NDArray[np.float64]:
    """Radians from a file, or from an array in radians.

    Args:
        unit: "deg" or "rad", whatever the file says; None: as it says.

    Raises:
        DataError: they cannot be read, or several lists could be meant.
    """
    if not isinstance(angles, Path | str):
        return np.atleast_1d(np.asarray(angles, np.float64))
    name, _, where = (str(angles), "", "") if Path(angles).exists() else str(angles).rpartition("::")
    path, where = (Path(name), where) if name else (Path(where), "")
    if holds_arrays(path):
        with hdf5.readable(path):
            return angles_at(path, where, unit, default="degrees")
    if path.is_file() and hdf5.is_hdf5(path):
        return angles_at(path, where.replace("\\", "/"), unit)
    try:
        return parse_angles(text_in(path), str(path), where, unit)
    except OSError as error:
        raise DataError(f"The angles in {path} cannot be read ({hdf5.reason(error)}).") from error


def parse_angles(content: str, name: str, column: str = "", unit: str | None = None) -> NDArray[np.float64]:
    """Radians from text in degrees (see `plan.from_text`), or from a column of a table.

    Args:
        name: where the text came from.
        column: its name, or its number from 0 on; "": the only one that is named after angles.
        unit: as in `load_angles`.
    """
    try:
        text, stated = _column(content.splitlines(), column)
        if (factor := factor_of(unit or stated, ANGLE_UNITS)) is None:
            raise ValueError(f"the unit of its column is {stated!r}; say --angles-unit deg or rad")
        return from_text(text, unknown=True) * (factor / DEGREE)
    except ValueError as error:
        raise DataError(f"{name}: {error}.") from error


def _column(lines: list[str], wanted: str) -> tuple[str, str]:
    """The text of one column of a table, with an empty line for each that holds no angle, and its unit.

    A text without names of columns is one list, in degrees.
    """
    names, rows = _cells([line.split("#", 1)[0] if line.lstrip()[:1] != "#" else line for line in lines])
    if not (names or wanted):
        return "\n".join(lines), "deg"
    width = max(map(len, rows.values()), default=0)
    named = [number for number, name in enumerate(names) if (name == wanted if wanted else _ANGLE.search(name))]
    if not named and wanted.isdecimal() and int(wanted) < width:
        named = [int(wanted)]
    if len(named) != 1:
        held = ", ".join(names) or f"{width} without names"
        raise ValueError(f"its columns are {held}; name that of the angles, or its number from 0: FILE::COLUMN")
    cells = {number: row[named[0]] if named[0] < len(row) else "" for number, row in rows.items()}
    text = "\n".join(cells[number] or "nothing" if number in cells else "" for number in range(len(lines)))
    unit = _UNIT.search(names[named[0]]) if names else None
    return text, (unit[1] or unit[2]).strip() if unit else "deg"


def _cells(lines: list[str]) -> tuple[list[str], dict[int, list[str]]]:
    """The names of the columns of a table, [] where it has none, and the cells of its lines by their number.

    Names stand in the first line, or in the comment before it. No name is a number.
    """
    filled = [number for number, line in enumerate(lines) if line.strip()]
    data = [number for number in filled if lines[number].lstrip()[0] != "#"]
    heads = [data[0], *[n for n in filled if n < data[0]][::-1]][:2] if data else []
    last, names, mark, head = lines[data[-1]] if data else "", list[str](), "\n", -1
    for head in heads:
        text = lines[head].strip().lstrip("# ")
        mark = next(
            (mark for mark in (";", "\t", ",", None) if len(last.split(mark)) == len(text.split(mark)) > 1), "\n"
        )
        names = [cell.strip(' "') for cell in text.split(mark)]
        named = any(re.search("[a-z]{2}", name, re.IGNORECASE) for name in names) and not any(
            map(_VALUE.fullmatch, names)
        )
        if named and (len(names) > 1 or (head == data[0] and _ANGLE.search(text))):
            break
        names = []
    return names, {n: [cell.strip(' "') for cell in lines[n].split(mark)] for n in data if not (names and n == head)}
