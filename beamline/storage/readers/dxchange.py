"""Scan files in the Data Exchange format: the /exchange group (De Carlo et al. 2014, J. Synchrotron Rad. 21, 1224)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import open_array_file, zarr_root
from beamline.storage.frame_table import FrameTable
from beamline.storage.readers.base import NamedArrays, NotUsed, Opening, ScanFormat
from beamline.storage.readers.fields import (
    EXCHANGE,
    EXCHANGE_ENERGY_UNITS,
    EXCHANGE_LENGTH_UNITS,
    EXCHANGE_TIME_UNITS,
    stated_in,
)
from beamline.storage.readers.nexus import differing
from beamline.storage.readers.orders import (
    SINOGRAM,
    USUAL,
    Order,
    as_frames,
    dimensions,
    dimensions_without_ones,
    order_of_axes,
)
from beamline.storage.readers.stacks import FrameStack, StacksSource
from drivers.base.frame import FrameKind

_UNKNOWN = "the names are unknown; theta:y:x is assumed"
_DETECTOR = "measurement/instrument/detector"
_FLATS = "process/acquisition/flat_fields"
_ANY = {"": 1.0, "x": 1.0, "1": 1.0, "dimensionless": 1.0, "pixel": 1.0}  # units of numbers without a unit
# plausible ranges of keV, and of mm of a detector, for numbers without a unit
_ENERGIES, _SIZES = (0.01, 1e4), (1e-6, 1.0)
_THETAS = {FrameKind.DARK: "exchange/theta_dark", FrameKind.FLAT: "exchange/theta_white"}
TEXTS = {"title": "exchange/title", "sample": "measurement/sample/name"}
PLACES = (
    (FrameKind.DARK, "/exchange/data_dark"),
    (FrameKind.FLAT, "/exchange/data_white"),
    (FrameKind.PROJECTION, "/exchange/data"),
)

_OTHERS = (("angle", "theta"), ("dark", "data_dark"), ("flat", "data_white"))  # names of options, and datasets


def open_exchange(path: Path, *, follow: bool = False, own_angles: bool = True) -> ExchangeSource:
    """Open a Data Exchange file. `own_angles` False: the caller supplies the angles, so theta may be absent."""
    file = open_array_file(path, follow)
    with hdf5.closed_on_error(file):
        for _, where in PLACES:
            datasets.refuse_broken(file, where)
        order = _order(file["exchange/data"])
        items = ((kind, where, datasets.dataset(file, where, (order or USUAL)[0] or 0)) for kind, where in PLACES)
        usual = order or (SINOGRAM if len(dimensions_without_ones(file["exchange/data"].shape)) == 2 else USUAL)
        stacks = [
            FrameStack(kind, where, as_frames(item, _order(item) or usual))
            for kind, where, item in items
            if item is not None
        ]
        facts = {**_attributes(file), "dimensions": dimensions(usual)} | (
            {"angles_from": "computed from start and step of the rotation, because the file has no exchange/theta"}
            if own_angles and "exchange/theta" not in file
            else {}
        )
        source = ExchangeSource(path, file, stacks, format="data_exchange", facts=facts)
        source.own_angles, source.grows, n_views = own_angles, not source.finished, len(stacks[-1].frames)
        if source.grows:
            source.rows = source.rows[:0]
            source.refresh()
        else:
            if own_angles:
                source.table.angles[-n_views:] = _theta(file, n_views)
            source.take_order(_thetas(file, stacks), _later_flats(file, source.table.flats.size))
            _set_exposures(source.table, file)
        units = datasets.attribute(file["exchange/data"], "units").lower().replace(" ", "_")
        if source.quantity == "unknown" and units in ("counts", "line_integrals"):
            source.quantity = "counts" if units == "counts" else "line_integrals"
        source.not_used = stated_in(EXCHANGE, file, source)
        _set_scale(source, file)
        if order is None and "axes" in file["exchange/data"].attrs:
            source.not_used += (NotUsed("exchange/data@axes", ":".join(_axes(file["exchange/data"])), _UNKNOWN, True),)
        return source


class ExchangeSource(StacksSource):
    """A scan in a Data Exchange file.

    Attributes:
        own_angles: True if the angles of the file are used.
        grows: True if the file was still being written when it was opened. Its frames are then numbered in the order in
            which they arrive.
    """

    own_angles: bool = True
    grows: bool = False
    angles_unit = "degrees"

    @property
    def stack_options(self) -> tuple[str, str]:
        return "exchange/data", "".join(f" --{name}s-path exchange/{where}" for name, where in _OTHERS)

    def exchange_sinogram(self, *, views_first: bool) -> str:
        right_axes = "x:theta" if views_first else "theta:x"
        return f"set the attribute axes of /exchange/data to {right_axes}"

    def refresh(self) -> int:
        if not self.grows:
            return super().refresh()
        ended, theta = self.finished, datasets.dataset(self._file, "exchange/theta") if self.own_angles else None
        n_written = [hdf5.n_written(stack.frames) for stack in self._stacks]
        angled = hdf5.n_written(theta) if theta is not None else n_written[-1]
        n_written[-1] = min(n_written[-1], angled)
        self.number_frames([len(stack.frames) for stack in self._stacks] if ended else n_written)
        views = self.table.views
        if self.own_angles:
            self.table.angles[views] = _theta(self._file, views.size, ended)[: views.size]
        _set_exposures(self.table, self._file)
        return len(self.table)

    def take_order(self, thetas: Mapping[FrameKind, NDArray[np.float64]], later: int | None) -> None:
        """Sort darks and flats among the projections, if the file says when flats were taken.

        Args:
            thetas: angles in radians at which the darks and the flats were taken, if the file states them.
            later: index of the first flat that was taken after the projections; None: the file does not state it.
        """
        table, place = self.table, np.full(len(self.table), -1.0)
        views = table.angles[table.views]
        place[table.views] = np.arange(views.size)
        steps = np.diff(views)
        in_turn = bool((steps > 0).all() or (steps < 0).all())
        for kind, theta in thetas.items() if in_turn else ():
            nearest = np.abs(views - theta[:, None]).argmin(axis=1)
            # frames taken after the projections
            place[table.of_kind(kind)] = np.where(nearest == views.size - 1, views.size, nearest - 0.5)
        turned = np.flatnonzero(np.diff(thetas.get(FrameKind.FLAT, np.zeros(1)))) + 1
        # the projections may be in any order; flats were taken at two positions of the stage
        if later is None and not in_turn and turned.size == 1:
            later = int(turned[0])
        if later is not None:
            place[table.flats[later:]] = views.size
        elif FrameKind.FLAT not in thetas or not in_turn:
            return
        order = np.argsort(place, kind="stable")
        self.table, self.rows = FrameTable.of(table.kinds[order], table.angles[order]), self.rows[order]
        self.in_order = in_turn and {*table.kinds.tolist()} <= {*thetas, FrameKind.PROJECTION}


def _thetas(file: h5py.File, stacks: Sequence[FrameStack]) -> dict[FrameKind, NDArray[np.float64]]:
    """Angles in radians at which the frames of each stack of darks or flats were taken, if the file states them."""
    listed = {part.kind: _list(file, _THETAS[part.kind], len(part.frames)) for part in stacks if part.kind in _THETAS}
    return {kind: theta for kind, theta in listed.items() if theta is not None}


def _later_flats(file: h5py.File, n: int) -> int | None:
    """The index of the first of n flats that was taken after the projections. It is known if the file states that
    equally many flats were taken before and after the projections.
    """
    mode = datasets.dataset(file, f"{_FLATS}/flat_field_mode")
    each = datasets.scalar(file, f"{_FLATS}/num_flat_fields", _ANY) or n // 2
    return n // 2 if mode is not None and _words(mode).lower() == "both" and 2 * each == n > 0 else None


def _list(file: h5py.File, where: str, n: int) -> NDArray[np.float64] | None:
    """Angles [frame] in radians. If no unit is stated, the unit of the projections' angles is used. None if there is no
    list of this length.
    """
    item = datasets.dataset(file, where)
    if item is None or item.size != n or item.dtype.kind not in "uif":
        return None
    of_views = datasets.attribute(datasets.dataset(file, "exchange/theta") or item, "units")
    known = datasets.factor_of(of_views, datasets.ANGLE_UNITS) is not None
    angles = datasets.radians(item, default=of_views if known else "degrees")
    return angles if np.isfinite(angles).all() else None


def _set_exposures(table: FrameTable, file: h5py.File) -> None:
    """Set the exposures: one exposure for all frames or one for each projection. Flats get another exposure if the file
    states it.
    """
    seconds = _seconds(file, f"{_DETECTOR}/exposure_time", table.views.size)
    if seconds is None:
        return
    table.exposures[:] = seconds[0] if seconds.size == 1 else np.nan
    table.exposures[table.views] = seconds
    differs = datasets.dataset(file, f"{_FLATS}/different_flat_exposure")
    of_flats = _seconds(file, f"{_FLATS}/flat_exposure_time", 1)
    if of_flats is not None and differs is not None and _words(differs).lower().startswith("different"):
        table.exposures[table.flats] = of_flats


def _seconds(file: h5py.File, where: str, n: int) -> NDArray[np.float64] | None:
    """Positive times in s: a single one, or one for each frame. None if the file has no times, or if their unit is
    unknown.
    """
    item = datasets.dataset(file, where)
    values = None if item is None or item.size not in (1, n) else datasets.in_units(item, EXCHANGE_TIME_UNITS)
    return values if values is not None and (values > 0).all() else None


def _words(item: h5py.Dataset) -> str:
    """A text. An area detector (EPICS) may have written its characters as numbers."""
    values = np.ravel(datasets.values_of(item))
    return (
        values.astype(np.uint8).tobytes().decode("ascii", "replace").strip("\0 ")
        if values.dtype.kind in "ui"
        else (datasets.text_of(item))
    )


def _axes(item: h5py.Dataset) -> list[str]:
    return [axis for part in np.ravel(item.attrs.get("axes", ())) for axis in datasets.text(part).split(":")]


def _order(item: h5py.Dataset) -> Order | None:
    """Which dimensions are frames, rows and columns according to the attribute `axes`; None if the attribute does not
    tell.
    """
    return order_of_axes(_axes(item))


def _set_scale(source: ExchangeSource, file: h5py.File) -> None:
    """Read pixel size and energy. A value in an impossible unit is added to `not_used`."""
    pixel = file.attrs.get("pixel_size_mm")
    source.pixel_size_mm = float(pixel) if isinstance(pixel, int | float) and np.isfinite(pixel) else None
    energy = "measurement/instrument/monochromator/energy"
    source.energy_kev = _measured(source, file, energy, EXCHANGE_ENERGY_UNITS, _ENERGIES)
    if source.pixel_size_mm is None:
        lens = _positive(file, f"{_DETECTOR}/objective/magnification", _ANY) or 1.0
        sizes = []
        for side in "xy":
            size = _measured(source, file, f"{_DETECTOR}/{side}_pixel_size", EXCHANGE_LENGTH_UNITS, _SIZES)
            binning = _positive(file, f"{_DETECTOR}/{side}_binning", _ANY) or 1.0
            sizes.append(None if size is None else size * binning / lens)
        source.pixel_size_mm, source.row_pitch_mm = sizes[0], differing(sizes[1], sizes[0])


def _measured(
    source: ExchangeSource, file: h5py.File, where: str, units: Mapping[str, float], range: tuple[float, float]
) -> float | None:
    """A positive number. If it has no unit, an SI unit is assumed, as the format prescribes, provided that the value is
    then in a plausible range.
    """
    value, item = _positive(file, where, units), datasets.dataset(file, where)
    if value is None or item is None or datasets.attribute(item, "units") or range[0] <= value <= range[1]:
        return value
    source.not_used += (
        NotUsed(
            where,
            datasets.text_of(item),
            "the field has no attribute `units`, and in SI units the value is impossible",
            True,
        ),
    )
    return None


def _positive(file: h5py.File, where: str, units: Mapping[str, float]) -> float | None:
    value = datasets.scalar(file, where, units)
    return value if value is not None and value > 0 else None


def _theta(file: h5py.File, n_views: int, all_there: bool = True) -> NDArray[np.float64]:
    theta = datasets.dataset(file, "exchange/theta")
    if theta is None:
        datasets.refuse_broken(file, "exchange/theta")
        start, step = (_of_rotation(file, what) for what in ("start", "step"))
        if start is not None and step and abs(step) <= math.pi:
            return start + step * np.arange(n_views, dtype=np.float64)
        raise DataError(
            f"Give the angles with --angles FILE (degrees, one per line): {file.filename} has no /exchange/theta. "
            "Neither /process/acquisition/rotation nor the attributes of /exchange state a single start and a "
            "single step of the rotation (the step may be at most 180 degrees). Some programs assume 0 to 180 "
            "degrees in this case; `beamline` does not."
        )
    angles = datasets.radians(theta, default="degrees")
    if all_there and (angles.size != n_views or n_views not in (1, *theta.shape)):
        way = f" If the scan ended early, use the first angles: --angles-path /exchange/theta --angle-rows 0:{n_views}"
        remedy = way if angles.size > n_views else ""
        raise DataError(
            f"{file.filename}: /exchange/theta has {angles.size} angles for {n_views} projections, shape "
            f"{theta.shape}; expected one angle for each projection.{remedy}"
        )
    return angles


def _of_rotation(file: h5py.File, what: str) -> float | None:
    """A single number about the rotation, converted to radians, from the acquisition group or from attributes of the
    exchange data. It is in degrees unless a unit is stated. None if no number, or several, are stated.
    """
    attributes = [item.attrs.get(f"rotation_{what}") for item in (file["exchange"], file["exchange/data"])]
    by_group = datasets.scalar(
        file, f"process/acquisition/rotation/{what}", {**datasets.ANGLE_UNITS, "": math.radians(1)}
    )
    numbers = {by_group, *(math.radians(value) for value in attributes if isinstance(value, np.number))} - {None}
    return numbers.pop() if len(numbers) == 1 else None


def _attributes(file: h5py.File) -> dict[str, str | float | int]:
    facts: dict[str, str | float | int] = {}
    for name, value in file.attrs.items():
        if isinstance(value, np.number):
            facts[name] = float(value)
        else:
            facts[name] = " ".join(datasets.text(part) for part in np.ravel(value))
    for name, where in TEXTS.items():
        if datasets.dataset(file, where) is not None:
            facts[name] = datasets.text_at(file, where)[: datasets.NAME]
    facts["theta_units"] = datasets.attribute(datasets.dataset(file, "exchange/theta") or file, "units") or "not given"
    return facts


def _recognises(path: Path, opening: Opening) -> bool:
    if not hdf5.is_hdf5(path, opening.follow) and zarr_root(path) is None:
        return False
    with closing(open_array_file(path, opening.follow)) as file:
        return datasets.dataset(file, "exchange/data") is not None or bool(datasets.broken_link(file, "exchange/data"))


def _scan_of_arrays(path: Path, arrays: NamedArrays) -> ExchangeSource | None:
    own = arrays.alone and arrays.data.strip("/") == "exchange/data" and _recognises(path, Opening())
    return open_exchange(path, own_angles=arrays.own_angles) if own else None


def _references(path: Path, file: h5py.File, kind: FrameKind) -> ExchangeSource | None:
    there = all(datasets.dataset(file, where) is not None for where in (dict(PLACES)[kind], "exchange/data"))
    return open_exchange(path, own_angles=False) if there else None


FORMAT = ScanFormat(
    "/exchange/data (Data Exchange)",
    _recognises,
    lambda path, opening: open_exchange(path, follow=opening.follow, own_angles=opening.own_angles),
    _scan_of_arrays,
    _references,
)
