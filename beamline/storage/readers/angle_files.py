"""Angles from a separate file: reads them, and assigns them to the frames if their number matches."""

from __future__ import annotations

import re
import shlex
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.files import text_in
from beamline.plan.plan import from_text
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import holds_arrays, open_array_file
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.stacks import arrays_of, dataset_at, datasets_text, in_frame_of_detector
from beamline.storage.readers.tiff import OTHER_FILES

Angles = Path | str | ArrayLike
"""Where angles come from: a file, or FILE::NAME for a column or a dataset, in degrees unless the file states a unit. Or
an array in radians.
"""
_ANGLE = re.compile(r"angle|theta|rotation|omega|phi|degree|\bdeg\b|°", re.IGNORECASE)  # a word for angles
_UNIT = re.compile(r"[\[(]([^\])]+)[\])]$|[ _](deg|degrees?|m?rad|radians?)$", re.IGNORECASE)  # a unit after a name
_VALUE = re.compile(r"[-+]?(\.?\d|nan\b|inf\b)", re.IGNORECASE)  # a name does not begin like this


def load_angles(angles: Angles, unit: str | None = None) -> NDArray[np.float64]:
    """Radians from a file, or from an array in radians.

    Args:
        unit: "deg" or "rad", whatever the file states; None: the unit that it states.

    Raises:
        DataError: the angles cannot be read, or it is unclear which of several lists is meant.
    """
    if not isinstance(angles, Path | str):
        return np.atleast_1d(np.asarray(angles, np.float64))
    name, _, where = (str(angles), "", "") if Path(angles).exists() else str(angles).partition("::")
    path = Path(name)
    if (arrays := holds_arrays(path)) or (path.is_file() and hdf5.is_hdf5(path)):
        with hdf5.readable(path):
            return angles_at(path, where.replace("\\", "/"), unit, "degrees" if arrays else "")
    try:
        return parse_angles(text_in(path), str(path), where, unit)
    except OSError as error:
        raise DataError(f"The angles in {path} cannot be read ({hdf5.reason(error)}).") from error


def angles_at(path: Path, where: str, unit: str | None, default: str = "") -> NDArray[np.float64]:
    """Angles in radians of the array `where` of an HDF5 file, a Zarr or an .npy: a list or a column.

    Args:
        where: "": the only list whose unit is one of angles, or the only array.
        unit: "deg" or "rad", whatever the file states; None: the unit that it states, or `default` if it states none.

    Raises:
        DataError: the array does not exist, is not a list, or has no known unit.
    """
    with closing(open_array_file(path)) as file, hdf5.readable(path):
        if not where and isinstance(file, h5py.File):
            where = _only_angles(file)
        item = dataset_at(file, where)
        if item.ndim == 0 or item.size != max(item.shape):
            raise DataError(f"{item.name} in {path} has the shape {item.shape}; expected a list of angles.")
        return in_frame_of_detector(item, datasets.radians(item, unit, default), unit)


def _only_angles(file: h5py.File) -> str:
    """The path of the only list of a file whose unit is one of angles."""
    names = [
        str(item.name)
        for item in arrays_of(file)
        if item.ndim == 1 and datasets.factor_of(datasets.attribute(item, "units"), datasets.ANGLE_UNITS)
    ]
    if len(names) != 1:
        raise DataError(
            f"{file.filename} has {len(names)} lists in a unit of angles. {datasets_text(file)} Name the list of "
            "angles: --angles FILE::DATASET. If this dataset states no unit, also give --angles-unit deg or rad."
        )
    return names[0]


def parse_angles(content: str, name: str, column: str = "", unit: str | None = None) -> NDArray[np.float64]:
    """Angles in radians from text in degrees (see `plan.from_text`), or from a column of a table as described in
    `load_angles`.

    Args:
        name: origin of the text, for messages.
    """
    try:
        text, stated = _column(content.splitlines(), column)
        if (factor := datasets.factor_of(unit or stated, datasets.ANGLE_UNITS)) is None:
            raise ValueError(f"the unit of the angles is {stated!r}; give --angles-unit deg or rad")
        return from_text(text, unknown=True) * (factor / datasets.DEGREE)
    except ValueError as error:
        table = ". For a table, FILE::COLUMN names one column: by its name, or its number from 0" * (
            "column" in str(error) or "its angle" in str(error)
        )
        raise DataError(f"{name}: {error}{table}.") from error


def _column(lines: list[str], wanted: str) -> tuple[str, str]:
    """The text of one column of a table, with one line for each row, and the unit of the column.

    Args:
        wanted: name of the column, or its number counted from 0. "": the only column whose name means angles. Names are
            in the first line, which may be a comment. A text without names is a single list, in degrees.
    """
    filled = [number for number, line in enumerate(lines) if line.strip()] or [0]
    head, last = (lines[filled[end]].strip() if lines else "" for end in (0, -1))
    bare = head.lstrip("# ")
    mark = next((mark for mark in (";", "\t", ",", None) if len(last.split(mark)) == len(bare.split(mark)) > 1), "\n")
    names = [cell.strip(' "') for cell in bare.split(mark)]
    titled = not any(map(_VALUE.match, names)) and (len(names) > 1 or (head == bare and bool(_ANGLE.search(bare))))
    if not (titled or wanted):
        return "\n".join(lines), "deg"
    chosen = [n for n, title in enumerate(names) if titled and (title == wanted if wanted else _ANGLE.search(title))]
    chosen = chosen or ([int(wanted)] if wanted.isdecimal() else [])
    if len(chosen) != 1 or chosen[0] >= len(names):
        held = f"its columns are {', '.join(names)}" if titled else f"its {len(names)} columns have no names"
        raise ValueError(f"{held}; expected exactly one column whose name means angle, such as angle or theta")
    for number, line in enumerate(lines):
        cells = [] if line.lstrip()[:1] in ("", "#") or (titled and number == filled[0]) else line.split(mark)
        lines[number] = (cells + [""] * len(names))[chosen[0]].strip(' "') or "(empty)" * bool(cells)
    unit = _UNIT.search(names[chosen[0]]) if titled else None
    return "\n".join(lines), (unit[1] or unit[2]).strip() if unit else "deg"


def select_rows(angles: NDArray[np.float64], rows: str) -> NDArray[np.float64]:
    """Select the rows "a:b" of the angles, counted from 0. Row b is not included; a or b may be left out."""
    match = re.fullmatch(r"(\d*):(\d*)", rows.strip())
    if match is None:
        raise DataError(
            f"--angle-rows {shlex.quote(rows)} is wrong; expected A:B, such as 10:101: lines A to B - 1, counted "
            "from 0."
        )
    first = int(match[1] or 0)
    last = int(match[2] or angles.size)
    if not 0 <= first < last <= angles.size:
        raise DataError(f"--angle-rows {rows} is out of range: the file has {angles.size} angles.")
    return angles[first:last]


def assign(
    source: ScanSource, angles: NDArray[np.float64], name: str, *, of_views: bool = False
) -> NDArray[np.float64]:
    """Assign an angle in radians to each frame of a source, NaN if unknown.

    Three cases fit. (1) There is one angle for each projection. (2) There is one angle for each number of a series of
    files, of which some are missing. (3) There is one angle for each frame, and the order of all frames is known; a log
    with nan for each dark and flat also states this order. A log with equal steps from end to end contains no rows of
    darks and flats, because the stage stands still while these are taken.

    Args:
        name: where the angles come from, for messages.
        of_views: True if the angles are those of the projections only.

    Raises:
        DataError: the angles fit none of these cases. The message names the rows that are certainly those of the
            projections, if there are any.
    """
    projections, numbers = source.table.views, source.table.numbers
    series = None if numbers is None else numbers[projections]
    spread, all_frames = np.full(len(source.table), np.nan), angles.size == len(source.table) and not of_views
    known = np.isfinite(angles)
    if angles.size == projections.size:
        spread[projections] = angles
    elif numbers is not None and not of_views and _count_all(numbers, angles.size):
        spread = angles[numbers - numbers.min()]
    elif all_frames and source.in_order:
        spread = angles
    elif series is not None and _count_all(series, angles.size) and (not all_frames or _in_equal_steps(angles)):
        spread[projections] = angles[series - series.min()]
    elif all_frames and known.sum() == projections.size:
        spread[projections] = angles[known]
    else:
        raise DataError(_misfit(source, angles, name, series))
    return spread


def _count_all(numbers: NDArray[np.int64], n: int) -> bool:
    """True if the numbers of the files are all different, and include the first and the last of n numbers."""
    return bool(numbers.min() >= 0 and np.ptp(numbers) + 1 == n and np.unique(numbers).size == numbers.size)


def _in_equal_steps(angles: NDArray[np.float64]) -> bool:
    """True if every step has between half and one and a half times the typical length."""
    steps = np.diff(angles)
    typical = float(np.median(steps))
    return bool((np.abs(steps - typical) < abs(typical) / 2).all())


def _misfit(source: ScanSource, angles: NDArray[np.float64], name: str, series: NDArray[np.int64] | None) -> str:
    n, frames = source.table.views.size, len(source.table)
    if frames == 1 < angles.size:
        n_rows, n_cols = source.shape
        return (
            f"{name} has {angles.size} angles, but {source.path} is one image of {n_rows} x {n_cols} pixels. If the "
            "image is a sinogram, its rows or its columns are the projections: give one angle for each row or each "
            "column, or use --angle-rows A:B to choose the angles of this image (lines A to B - 1, counted from 0)."
        )
    if angles.size < n:
        message = f"{name} has only {angles.size} angles for {n} projections"
    elif angles.size == frames:
        message = (
            f"{name} has {angles.size} angles, one for each frame, but {source.path} does not state when "
            "its darks and flats were taken"
        )
    else:
        message = f"{name} has {angles.size} angles, but {n} of the {frames} frames are projections"
    for n_images in [field.value for field in source.not_used if field.where == OTHER_FILES][:1]:
        message += (
            f". According to its OME metadata, {source.path} is one file of a set, and the other files contain "
            f"{n_images} images: add the other files with --append FILE"
        )
    if series is not None and (gaps := source.attributes.get("missing_numbers")):
        message += (
            f". The image numbers run from {series.min()} to {series.max()} and leave out {gaps}: with "
            f"{np.ptp(series) + 1} angles, one for each number, each image would get its own angle"
        )
    elif series is not None and n < angles.size != frames:
        message += (
            f". The image numbers run from {series.min()} to {series.max()} without a gap. If the scan "
            f"had {angles.size} images, the first or the last {angles.size - n} images are missing"
        )
    if angles.size < n:
        return (
            f"{message}. Is the list cut off, or does it belong to another scan? Give one angle for each projection, "
            "in the order of the projections. If some of the images are darks or flats, name these images with "
            "--frames, or give them with --darks and --flats."
        )
    sinograms, window = "", evenly_spaced_window(angles, n)
    if angles.size in source.shape:
        order = ("row,view,col", "row,col,view")[source.shape.index(angles.size)]
        sinograms = f"If each image is a sinogram of {angles.size} projections, give --order {order}. Otherwise use"
        if not source.table.are_views.all():
            sinograms = (
                f"If one image is a sinogram of {angles.size} projections, give this image alone as FILE, and the "
                "other images with --darks and --flats. Otherwise use"
            )
    message += (
        f". {sinograms or 'Use'} --angle-rows A:B to choose the {n} angles of the projections (lines A to B - 1, "
        "counted from 0)"
    )
    if window is None:
        return f"{message}."
    low, high = np.degrees(angles[list(window)])
    lines = f"{window[0]}:{window[1] + 1}"
    return (
        f"{message}. --angle-rows {lines} uses the {n} consecutive angles with the most equal steps, from "
        f"{low:.4f} to {high:.4f} degrees."
    )


def evenly_spaced_window(angles: NDArray[np.float64], n: int) -> tuple[int, int] | None:
    """First and last row of the n consecutive rows with the most equal steps; None if the choice is ambiguous.

    A scan's angle log often also contains the darks and flats, during which the stage stands still. If equal steps
    continue beyond these n rows, other rows would fit as well: then projections are missing, and it is unknown which.
    """
    if n < 3 or angles.size <= n or not np.isfinite(angles).all():
        return None
    steps = np.diff(angles)
    windows = np.lib.stride_tricks.sliding_window_view(steps, n - 1)
    medians = np.median(windows, axis=1)
    moving = np.flatnonzero(medians != 0)
    if moving.size == 0:
        return None
    uneven = np.abs(windows - medians[:, None]).max(axis=1)[moving] / np.abs(medians[moving])
    first = int(moving[np.argmin(uneven)])
    beside = np.concatenate((steps[first - 1 : first] if first else [], steps[first + n - 1 : first + n]))
    if (np.abs(beside - medians[first]) < np.abs(medians[first]) / 2).any():
        return None
    return first, first + n - 1
