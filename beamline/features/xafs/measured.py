"""Measured: reads energies with absorption or radiographs, from a text table or an HDF5 file."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in
from beamline.core.flag import PixelBox
from beamline.features.xafs.contrast import ContrastRegions, XafsCurve
from beamline.features.xafs.series import EVERYTHING, FramePart, Radiographs, Series, counts_in, line_integrals
from beamline.storage import datasets, hdf5
from beamline.storage.datasets import require_real
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from recon.base.units import look_like_transmission
from recon.base.views import spread

_MOST_VIEWS = 32  # evenly spread: more say little more of a region, and take long to read
Reals = NDArray[np.float64]
EV_BEYOND, KEV_BELOW = 500.0, 0.05
"""keV: no beamline has energies above the first or below the second, so that their unit is wrong."""
_LOOKED_AT = 8  # frames, for transmission given as line integrals
_KEV = {"keV": 1.0, "eV": 1e-3}
_MOST = 1e30  # absorption in any unit: more is a fault of the file, and squares of more are beyond floats


class ScanRadiographs:
    """The scans of one sample, one at each energy.

    The mean over views from all sides shows a region of the detector alike at all energies, though each scan has angles
    of its own.

    Raises:
        DataError: a scan does not state its energy, or frames differ in size.
    """

    def __init__(self, scans: Sequence[Path]) -> None:
        self._scans, energies, shapes = list(scans), list[float](), set[tuple[int, int]]()
        for path in scans:
            with open_scan(path) as source:
                if source.energy_kev is None:
                    raise DataError(
                        f"{path} does not state its energy; expected /entry/instrument/beam/incident_energy. "
                        "Nothing was written."
                    )
                energies.append(source.energy_kev)
                shapes.add(source.shape)
        if len(shapes) != 1:
            sizes = ", ".join(f"{rows} x {cols}" for rows, cols in sorted(shapes))
            raise DataError(f"The scans have frames of {sizes} pixels; expected one size. Nothing was written.")
        self.energies, (self.shape,) = np.array(energies), shapes

    def line_integrals(self, which: Sequence[int], part: FramePart = EVERYTHING) -> Iterator[tuple[float, Reals]]:
        """(keV, line integrals [row, col]) of the scans `which`, in that order, of a part of each frame; +inf and NaN
        as those of `Radiographs`."""
        for i in which:
            with open_scan(self._scans[i]) as source:
                dark = _mean(source, FrameKind.DARK, part)
                flat = _mean(source, FrameKind.FLAT, part) - dark
                views = _chosen(source, FrameKind.PROJECTION)
                scale = np.nanmean(source.exposures[views]) / np.nanmean(source.exposures[_all(source, FrameKind.FLAT)])
                flat = flat * (scale if np.isfinite(scale) else 1.0)
                total = sum(line_integrals(_frame(source, view, part) - dark, flat) for view in views)
                yield float(self.energies[i]), np.asarray(total / views.size, np.float64)


def _all(source: ScanSource, kind: FrameKind) -> NDArray[np.int64]:
    frames = np.flatnonzero(source.image_key == kind)
    if not frames.size:
        raise DataError(f"{source.path} has no {kind.name.lower()}s. Nothing was written.")
    return frames


def _chosen(source: ScanSource, kind: FrameKind) -> NDArray[np.int64]:
    return spread(_all(source, kind), _MOST_VIEWS)


def _frame(source: ScanSource, index: int, part: FramePart) -> Reals:
    return counts_in(source.read(np.array([index]), part[0])[0][:, part[1]])


def _mean(source: ScanSource, kind: FrameKind, part: FramePart) -> Reals:
    chosen = _chosen(source, kind)
    return np.asarray(sum(_frame(source, index, part) for index in chosen) / chosen.size, np.float64)


def read_table(path: Path, unit: str | None) -> XafsCurve:
    """Two columns of text, energy and absorption, separated by commas, semicolons, tabs or blanks; lines that begin
    with a letter, # or % are skipped. With another separator the comma may be the decimal point.

    Args:
        unit: of the energy, "keV" or "eV"; None: keV.

    Raises:
        DataError: it does not exist, or is not such a table.
    """
    try:
        lines = text_in(path).splitlines()
    except OSError as error:
        raise DataError(f"{path} cannot be read ({error.strerror or error}).") from error
    rows = []
    for number, line in enumerate(lines, start=1):
        if not line.strip() or re.match(r"\s*(?!(?:nan|inf)\b)[#%A-Za-z\"]", line, re.IGNORECASE):
            continue
        try:
            energy, absorption = (float(field) for field in _fields(line.strip())[:2])
        except ValueError:
            raise DataError(f"{path}, line {number}: {line.strip()!r} is not an energy and an absorption.") from None
        rows.append((energy, absorption))
    values = np.array(rows, dtype=np.float64).reshape(-1, 2)
    return XafsCurve(_in_kev(path, values[:, 0], unit), _finite(path, "absorption", values[:, 1]))


def _fields(line: str) -> list[str]:
    if re.search(r"[;\t]", line) or re.match(r"[-+]?\d+,\d+\s+[-+]?\d+,\d+(?:\s|$)", line):
        return [re.sub(r"(?<=\d),(?=\d)", ".", field) for field in re.split(r"\s*[;\t]\s*|\s+", line)]
    return re.split(r"[,\s]+", line)


@dataclass(frozen=True)
class FileOptions:
    """The part of a file that is used, and properties that it does not state.

    Attributes:
        low, high: keV, the first and the last energy.
        region, around: (first row, row after the last, first column, column after the last) of the material, and of its
            surroundings, from which the material is excluded. None: the whole frame, and no surroundings.
        unit: of the energies, "keV" or "eV"; None: as in the file, else keV.
        quantity: of the frames, "counts" or "line_integrals"; None: counts.
    """

    low: float = 0.0
    high: float = np.inf
    region: PixelBox | None = None
    around: PixelBox | None = None
    unit: str | None = None
    quantity: str | None = None


@contextmanager
def open_series(path: Path, options: FileOptions, scans: Sequence[Path] = ()) -> Iterator[Series | XafsCurve]:
    """The curve or the radiographs of a file, which is open within the context.

    Args:
        scans: of a series in the folder `path`; none: it is a file.

    Raises:
        ConfigError: a region is not in the frame, or has no surroundings.
        DataError: not such a file, see `open_measured`, or an energy occurs twice.
    """
    opened: AbstractContextManager[XafsCurve | Radiographs | ScanRadiographs]
    opened = nullcontext(ScanRadiographs(scans)) if scans else open_measured(path, options.unit, options.quantity)
    with opened as source:
        order = np.argsort(source.energies, kind="stable")
        kept = order[(source.energies[order] >= options.low) & (source.energies[order] <= options.high)]
        energies = source.energies[kept]
        if not (rises := np.diff(energies) > 0).all():
            raise DataError(
                f"{path}: {energies[np.argmin(rises)]:.9g} keV occurs more than once; average the values of "
                "each energy. Nothing was written."
            )
        if isinstance(source, XafsCurve):
            if options.region or options.around:
                raise ConfigError(f"{path} has no frames, so that regions do not apply. Nothing was written.")
            yield XafsCurve(energies, source.absorption[kept], unit="as in the file")
            return
        inside = _mask(source.shape, options.region or (0, source.shape[0], 0, source.shape[1]))
        around = None if options.around is None else _mask(source.shape, options.around) & ~inside
        if around is not None and not around.any():
            raise ConfigError(f"{path}: --around has no pixel outside of --region. Nothing was written.")
        part = _bounds(inside if around is None else inside | around)
        regions = ContrastRegions(inside[part], None if around is None else around[part])
        yield Series(path.name, kept.size, source.line_integrals(kept.tolist(), part), regions)


def _bounds(mask: NDArray[np.bool_]) -> FramePart:
    """The rows and columns of the mask and its neighbouring pixels: only these are read from a frame."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return slice(max(int(rows[0]) - 1, 0), int(rows[-1]) + 2), slice(max(int(cols[0]) - 1, 0), int(cols[-1]) + 2)


def _mask(shape: tuple[int, int], box: PixelBox) -> NDArray[np.bool_]:
    if box[1] > shape[0] or box[3] > shape[1]:
        raise ConfigError(
            f"The region {box[0]}:{box[1]},{box[2]}:{box[3]} is not in frames of {shape[0]} x {shape[1]} pixels. "
            "Nothing was written."
        )
    mask = np.zeros(shape, dtype=np.bool_)
    mask[box[0] : box[1], box[2] : box[3]] = True
    return mask


@contextmanager
def open_measured(path: Path, unit: str | None, quantity: str | None) -> Iterator[XafsCurve | Radiographs]:
    """A text table, or an HDF5 file with `energy` [n] and either `mu` [n] or `frames` [n, row, col]. Beside frames it
    has `flats` ([n, row, col] or [row, col]), perhaps `darks` ([row, col] or [k, row, col]).

    Args:
        unit: of the energies, "keV" or "eV"; None: as in the dataset, else keV.
        quantity: "line_integrals" where frames need no flats.

    Raises:
        DataError: not such a file.
    """
    if path.is_file() and not h5py.is_hdf5(path):
        yield read_table(path, unit)
        return
    with hdf5.open_hdf5(path) as file:
        energies = _energies(path, file, unit)
        if (mu := _numbers(path, file, "mu")) is not None:
            if mu.shape != energies.shape:
                raise DataError(f"{path}: mu is {mu.shape}, but there are {energies.size} energies.")
            yield XafsCurve(energies, _finite(path, "mu", mu[()]))
            return
        frames, flats = _needed(path, file, "frames"), _numbers(path, file, "flats")
        if frames.ndim != 3 or frames.shape[0] != energies.size or 0 in frames.shape[1:]:
            raise DataError(f"{path}: frames are {frames.shape}; they must be [energy, row, col] of {energies.size}.")
        if quantity == "line_integrals":
            flats = None
            some = frames[spread(np.arange(len(frames)), _LOOKED_AT).tolist()]
            if look_like_transmission(np.asarray(some, np.float32)):
                raise DataError(
                    f"{path}: frames are about 1 at their edges and fall where the material is, as transmission does; "
                    "line integrals rise there. Leave out --quantity, and add flats of 1 to the file."
                )
        elif flats is None:
            raise DataError(
                f"{path}: frames without flats may be counts or line integrals. Add flats, or give --quantity "
                "line-integrals."
            )
        elif flats.shape not in (frames.shape, frames.shape[1:]):
            raise DataError(f"{path}: flats are {flats.shape}; they must be {frames.shape} or {frames.shape[1:]}.")
        yield Radiographs(energies, frames, flats, _darks(path, file, frames.shape[1:]))


def _energies(path: Path, file: h5py.File, unit: str | None) -> Reals:
    item = _needed(path, file, "energy")
    if unit is None and (stated := datasets.attribute(item, "units").lower()):
        unit = {"kev": "keV", "ev": "eV"}.get(stated)
        if unit is None:
            raise DataError(f"{path}: energies are in {stated!r}, which is neither keV nor eV; give --unit.")
    return _in_kev(path, np.ravel(item[()]), unit)


def _darks(path: Path, file: h5py.File, shape: tuple[int, ...]) -> h5py.Dataset | None:
    item = _numbers(path, file, "darks")
    if item is not None and (item.shape[-2:] != shape or item.ndim not in (2, 3) or item.size == 0):
        raise DataError(f"{path}: darks are {item.shape}; they must be {shape} or several of them.")
    return item


def _numbers(path: Path, file: h5py.File, name: str) -> h5py.Dataset | None:
    """A dataset of numbers; None where no dataset has that name."""
    item = datasets.dataset(file, name)
    if item is not None:
        require_real(item.dtype, f"{path}: {name}")
        if missing := datasets.missing_links(item):
            raise DataError(f"{path}: {name} is in {missing[0]}, which is not there.")
    return item


def _needed(path: Path, file: h5py.File, name: str) -> h5py.Dataset:
    item = _numbers(path, file, name)
    if item is None:
        raise DataError(
            f"{path} has no dataset {name}; it needs energy, and mu or frames (with flats). It has "
            f"{', '.join(sorted(file)) or 'nothing'}."
        )
    return item


def _finite(path: Path, name: str, values: Any) -> Reals:
    numbers = np.asarray(values, dtype=np.float64)
    if not np.isfinite(numbers).all():
        raise DataError(f"{path}: {name} is not a number at {int((~np.isfinite(numbers)).sum())} energies.")
    if beyond := np.count_nonzero(np.abs(numbers) > _MOST):
        raise DataError(f"{path}: {name} is beyond ±{_MOST:g} at {beyond} energies; expected a measured value.")
    return numbers


def _in_kev(path: Path, values: Reals, unit: str | None) -> Reals:
    energies = _finite(path, "energy", values) * _KEV[unit or "keV"]
    if not energies.size:
        return energies
    low, high = float(energies.min()), float(energies.max())
    if not KEV_BELOW <= low <= high <= EV_BEYOND:
        other = "keV" if unit == "eV" else "eV"
        factor = _KEV[other] / _KEV[unit or "keV"]
        possible = KEV_BELOW <= low * factor <= high * factor <= EV_BEYOND
        advice = f"; if they are {other}, give --unit {other}" if possible else ""
        raise DataError(
            f"{path}: energies from {low:g} to {high:g} keV are impossible, expected {KEV_BELOW:g} to {EV_BEYOND:g}"
            f"{advice}."
        )
    return energies
