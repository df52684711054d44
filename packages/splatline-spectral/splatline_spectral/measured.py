"""Reads absorption or radiographs over energies from a text table, an HDF5 file or a series of scans."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import text_in
from beamline.scan.series import scans_of
from beamline.storage.hdf5 import open_hdf5, readable
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import open_scan
from drivers.base.frame import FrameKind
from splatline_spectral.contrast import ContrastRegions, Reals, Series, XafsCurve, line_integrals

PixelBox = tuple[int, int, int, int]
FramePart = tuple[slice, slice]
Read = Callable[[int, FramePart], Reals]  # line integrals [row, col] at an energy, for a part of the frame

_MOST_VIEWS = 32  # number of projections, evenly spread; more would improve little and take long to read
_EV_BEYOND, _KEV_BELOW = 500.0, 0.05
"""keV: no beamline has energies above the first or below the second, so the unit must be wrong."""
_KEV = {"keV": 1.0, "eV": 1e-3}


@contextmanager
def open_measured(
    path: Path, span: tuple[float, float], region: PixelBox | None, around: PixelBox | None, unit: str | None
) -> Iterator[Series | XafsCurve]:
    """The curve or the radiographs of a file or a series of scans. The file is open within the context.

    Args:
        path: a text table of energy and absorption; HDF5 with `energy` [n] and `mu` [n], or `frames` [n, row, col] with
            `flats` ([n, row, col] or [row, col]) and perhaps `darks` ([row, col] or [k, row, col]); or the folder of a
            series of scans.
        span: first and last energy in keV.
        region, around: (first row, row after the last, first column, column after the last) of the material, and of its
            surroundings; the material is excluded from the surroundings. None: the whole frame; no surroundings.
        unit: unit of the energies, "keV" or "eV"; None: as in the file, else keV.

    Raises:
        ConfigError: a region is not in the frame, or has no surroundings.
        DataError: the file has another content, or an energy twice.
    """
    if path.is_file() and not h5py.is_hdf5(path):
        table = read_table(path)
        yield _sorted_curve(path, _in_kev(path, table[:, 0], unit), table[:, 1], span)
        return
    if path.is_dir():
        energies, shape, read = _of_scans(scans_of((path,), lambda message: None))
        yield _series(path, _order(path, energies, span), energies, _regions(path, shape, region, around), read)
        return
    with open_hdf5(path) as file, readable(path):
        if "energy" not in file or not {"mu", "frames"} & {*file}:
            raise DataError(
                f"{path} must have the dataset energy, and either mu or frames with flats. Nothing was written."
            )
        stated = {"ev": "eV", "kev": "keV"}.get(str(file["energy"].attrs.get("units", "")).lower())
        energies = _in_kev(path, np.ravel(file["energy"][()]), unit or stated)
        if "mu" in file:
            yield _sorted_curve(path, energies, np.ravel(file["mu"][()]), span)
            return
        frames = file["frames"]
        flats = file.get("flats")
        if frames.ndim != 3 or len(frames) != energies.size:
            raise DataError(
                f"{path}: frames has the shape {frames.shape}; expected [energy, row, col] with {energies.size} "
                "energies."
            )
        if flats is None or flats.shape not in (frames.shape, frames.shape[1:]):
            raise DataError(
                f"{path}: flats must have the shape {frames.shape} or {frames.shape[1:]}. Nothing was written."
            )

        def read(n: int, part: FramePart) -> Reals:
            darks = file.get("darks")
            dark = np.zeros(1) if darks is None else np.atleast_3d(darks[(..., *part)].T).mean(-1).T
            flat = counts_in(flats[part] if flats.ndim == 2 else flats[(n, *part)])
            return line_integrals(counts_in(frames[(n, *part)]) - dark, flat - dark)

        regions = _regions(path, frames.shape[1:], region, around)
        yield _series(path, _order(path, energies, span), energies, regions, read)


def read_table(path: Path) -> Reals:
    """Read two columns of text, energy and absorption, separated by commas, semicolons, tabs or blanks. Returns [n, 2].

    Lines before the first number, and lines that begin with # or %, are skipped.
    """
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(text_in(path).splitlines(), start=1):
        if not line.strip() or line.lstrip()[0] in "#%":
            continue
        try:
            energy, absorption, *_ = re.split(r"[,;\s]+", line.strip())
            rows.append((float(energy), float(absorption)))
        except ValueError:
            if rows:
                raise DataError(
                    f"{path}, line {number}: expected an energy and an absorption, got {line.strip()!r}."
                ) from None
    return np.array(rows, dtype=np.float64).reshape(-1, 2)


def _of_scans(scans: Sequence[Path]) -> tuple[Reals, tuple[int, int], Read]:
    """Energies, shape of the frames, and a function for the mean line integrals over projections from all sides. These
    means can be compared between energies, although each scan has angles of its own.
    """
    energies, shapes = list[float](), set[tuple[int, int]]()
    for path in scans:
        with open_scan(path) as source:
            if source.energy_kev is None:
                raise DataError(f"{path} must state its energy (instrument/beam/incident_energy of NXtomo).")
            energies.append(source.energy_kev)
            shapes.add(source.shape)
    if len(shapes) != 1:
        raise DataError(f"All scans must have frames of one size; found {sorted(shapes)} pixels. Nothing was written.")

    def read(n: int, part: FramePart) -> Reals:
        with open_scan(scans[n]) as source:
            dark = _mean(source, FrameKind.DARK, part)
            flat = _mean(source, FrameKind.FLAT, part) - dark
            views = _sampled_rows(source, FrameKind.PROJECTION)
            flats = source.table.exposures[source.table.flats]
            scale = np.nanmean(source.table.exposures[views]) / np.nanmean(flats)
            flat = flat * (scale if np.isfinite(scale) else 1.0)
            total = sum(line_integrals(_frame(source, view, part) - dark, flat) for view in views)
        return np.asarray(total / views.size, np.float64)

    return np.array(energies), shapes.pop(), read


def _sampled_rows(source: ScanSource, kind: FrameKind) -> NDArray[np.int64]:
    frames = source.table.of_kind(kind)
    if not frames.size:
        raise DataError(f"{source.path} has no {kind.name.lower()}s. Nothing was written.")
    return frames[np.unique(np.linspace(0, frames.size - 1, _MOST_VIEWS).round().astype(int))]


def _frame(source: ScanSource, index: int, part: FramePart) -> Reals:
    return counts_in(source.read(np.array([index]), part[0])[0][:, part[1]])


def _mean(source: ScanSource, kind: FrameKind, part: FramePart) -> Reals:
    return np.asarray(np.mean([_frame(source, index, part) for index in _sampled_rows(source, kind)], axis=0))


def counts_in(values: Any) -> Reals:
    """Counts as float; NaN if an integer is the largest of its type, because the pixel may be saturated."""
    counts = np.asarray(values, dtype=np.float64)
    if values.dtype.kind in "ui":
        counts[values == np.iinfo(values.dtype).max] = np.nan
    return counts


def _order(path: Path, energies: Reals, span: tuple[float, float]) -> NDArray[np.intp]:
    """Indices of the energies within the span, in rising order. Raises DataError if an energy occurs twice."""
    order = np.argsort(energies, kind="stable")
    order = order[(energies[order] >= span[0]) & (energies[order] <= span[1])]
    if not (np.diff(energies[order]) > 0).all():
        raise DataError(f"{path} has an energy more than once: average the values of each energy. Nothing was written.")
    return order


def _sorted_curve(path: Path, energies: Reals, absorption: Reals, span: tuple[float, float]) -> XafsCurve:
    if energies.shape != absorption.shape or not np.isfinite(absorption).all():
        raise DataError(f"{path}: expected a finite absorption for each of {energies.size} energies.")
    order = _order(path, energies, span)
    return XafsCurve(energies[order], np.asarray(absorption, np.float64)[order], unit="as in the file")


def _series(path: Path, order: NDArray[np.intp], energies: Reals, regions: ContrastRegions, read: Read) -> Series:
    mask = regions.inside if regions.around is None else regions.inside | regions.around
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    # Read only these rows and columns, and their neighbours.
    part = slice(max(int(rows[0]) - 1, 0), int(rows[-1]) + 2), slice(max(int(cols[0]) - 1, 0), int(cols[-1]) + 2)
    regions_of_part = ContrastRegions(regions.inside[part], None if regions.around is None else regions.around[part])
    return Series(path.name, order.size, ((float(energies[n]), read(int(n), part)) for n in order), regions_of_part)


def _regions(path: Path, shape: tuple[int, int], region: PixelBox | None, around: PixelBox | None) -> ContrastRegions:
    inside = _mask(shape, region or (0, shape[0], 0, shape[1]))
    outside = None if around is None else _mask(shape, around) & ~inside
    if outside is not None and not outside.any():
        raise ConfigError(f"{path}: --around has no pixel outside of --region. Nothing was written.")
    return ContrastRegions(inside, outside)


def _mask(shape: tuple[int, int], box: PixelBox) -> NDArray[np.bool_]:
    if box[1] > shape[0] or box[3] > shape[1]:
        raise ConfigError(
            f"The region {box[0]}:{box[1]},{box[2]}:{box[3]} is outside of frames of {shape[0]} x {shape[1]} pixels. "
            "Nothing was written."
        )
    mask = np.zeros(shape, dtype=np.bool_)
    mask[box[0] : box[1], box[2] : box[3]] = True
    return mask


def _in_kev(path: Path, values: Reals, unit: str | None) -> Reals:
    energies = np.asarray(values, np.float64) * _KEV[unit or "keV"]
    if not ((energies >= _KEV_BELOW) & (energies <= _EV_BEYOND)).all():
        raise DataError(
            f"{path}: energies from {energies.min():g} to {energies.max():g} keV are impossible; expected "
            f"{_KEV_BELOW:g} to {_EV_BEYOND:g} keV. Give the unit of the file with --unit. Nothing was written."
        )
    return energies
