"""NXtomoSource: scans as NXtomo lays them out: ours (also while they grow), ESRF's, and Diamond's NeXus with links.

What counts is the structure, an NXdetector with `data` [frame, row, col] and `image_key`, wherever the entry is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeVar

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.process import json_object
from beamline.monitor.digest import has_checksum
from beamline.storage import datasets, hdf5
from beamline.storage.datasets import require_real
from beamline.storage.flag_legend import FrameFlags, read_flags
from beamline.storage.parts import decisions_in, gaps_in, pass_ends_in, require_joined
from beamline.storage.readers.base import (
    WHOLE,
    NotUsed,
    Opening,
    Quantity,
    ScanFormat,
    ScanSource,
    count_in_blocks,
    frame_indices,
)
from beamline.storage.readers.fields import NXTOMO, UPRIGHT, stated_in
from beamline.storage.readers.nexus import (
    Places,
    choose,
    differing,
    find,
    read_energies,
    read_energy,
    read_geometry,
    require_order,
)
from beamline.storage.structure import drawn_on
from beamline.storage.writers import layout
from beamline.storage.writers.rows import RUNNING, ScanEnding, altered_rows, ending_in, require_earlier
from drivers.base.frame import FrameKind
from recon.base.arrays import Mask

_T = TypeVar("_T")


def _guarded(method: Callable[[NXtomoSource], _T]) -> Callable[[NXtomoSource], _T]:
    """The method, with h5py's errors as DataError."""

    @wraps(method)
    def guarded(self: NXtomoSource) -> _T:
        with hdf5.readable(self.path):
            return method(self)

    return guarded


class NXtomoSource(ScanSource):
    """A scan with the structure of NXtomo; see ScanSource."""

    def __init__(self, path: Path, *, follow: bool = False, own_angles: bool = True, data: str | None = None) -> None:
        """Open. `own_angles` False: the caller brings the angles, so the file's may be absent or without units.

        `data` is where the frames are, of several detectors; None: of the only one, or the file's default.
        """
        self.path = path
        self._file = hdf5.open_hdf5(path, follow)
        with hdf5.closed_on_error(self._file):
            found = find(self._file)
            self._places = places = choose(self._file, found, data)
            self._ours = layout.COMMITTED in self._file
            self._check()
            shape = places.data.shape
            self.shape = (int(shape[1]), int(shape[2]))
            self.dtype = places.data.dtype
            definition = datasets.text_at(places.entry, "definition") or datasets.attribute(places.entry, "definition")
            self.format = _format(definition, datasets.text_at(places.entry, "program_name"))
            stated_quantity = datasets.text_at(self._file, "/entry/record/quantity")
            self.quantity = _quantity(stated_quantity, self.dtype)
            self._geometry = None if self._ours else read_geometry(places)
            if self._geometry is None:
                self.pixel_size_mm = datasets.scalar(places.detector, "x_pixel_size", datasets.LENGTH_UNITS)
                self.cone = self._cone()
            else:
                self.pixel_size_mm, height = self._geometry.pixel_mm
                self.row_pitch_mm = differing(height, self.pixel_size_mm)
                self.cone = self._geometry.cone
                self.pixel_mask = self._mask(self._geometry.mirrored)
            self.energy_kev = read_energy(places.entry)
            # NXtomo's x_rotation_axis_pixel_position counts from the edge for some and from the middle for others.
            self.axis_col = datasets.scalar(self._file, "/entry/record/axis_col", {"pixel": 1.0})
            self.n = 0
            self._damaged: set[int] = set()
            self._altered: set[int] = set()
            self._own_angles = own_angles
            self.refresh()
            if self._geometry is not None:
                self._find_stated(found if data is None else [], self._geometry.turned)
                self.energies, self.currents = read_energies(places.entry, self.n), self._currents()
            else:
                self.plan = json_object(datasets.text_at(self._file, "/entry/record/plan")) or {}
                devices = (self._file.get("/entry/instrument/devices") or {}).values()
                periods = (float(device["row_period"][()]) for device in devices if "row_period" in device)
                self.row_period = next(periods, None)

    def _cone(self) -> tuple[float, float] | None:
        sod = datasets.scalar(self._file, layout.SOURCE_DISTANCE, datasets.LENGTH_UNITS)
        beyond = datasets.scalar(self._places.detector, "distance", datasets.LENGTH_UNITS)
        if sod is None or beyond is None:
            return None
        if sod <= 0 or beyond < 0:
            raise DataError(
                f"{self.path}: the source is {sod:g} mm before the sample and the detector {beyond:g} mm behind it; "
                "expected a positive distance of the source. Correct it in a copy of the file."
            )
        return sod, sod + beyond

    def _mask(self, mirrored: tuple[bool, bool]) -> Mask | None:
        """Pixels that NXdetector's mask names, for any of its reasons; None without a mask of the frames' shape."""
        item = datasets.dataset(self._places.detector, "pixel_mask")
        if item is None or item.shape[-2:] != self.shape or item.dtype.kind not in "uib":
            return None
        if item.size != self.shape[0] * self.shape[1]:
            return None
        mask = np.asarray(datasets.values_of(item)).reshape(self.shape) != 0
        return mask[:: -1 if mirrored[0] else 1, :: -1 if mirrored[1] else 1]

    def _check(self) -> None:
        finer = datasets.dataset(self._places.detector, "image_key_control")
        for item in (self._places.data, self._places.image_key, finer):
            if item is not None:
                require_real(item.dtype, f"{item.name} in {self.path}")
        datasets.require_possible(self._places.data)
        if self._ours:
            require_joined(self._file)
        else:
            require_order(self._places)
        lost = datasets.missing_links(self._places.data) + datasets.missing_links(self._places.image_key)
        if lost:
            raise DataError(
                f"{self.path} draws its frames from {lost[0]}, which is not there or differs ({len(lost)} such)."
            )

    @_guarded
    def refresh(self) -> int:
        places = self._places
        finer = datasets.dataset(places.detector, "image_key_control")
        if self._ours:
            finer = datasets.dataset(places.entry, "frame_log/kind")
        key = places.image_key if finer is None else finer
        n = self._committed(key) if self._ours else int(places.data.shape[0])
        angles = datasets.radians(places.angle) if places.angle is not None and self._own_angles else np.full(n, np.nan)
        keys = np.ravel(datasets.values_of(key))
        sizes = (int(places.data.shape[0]), keys.size, angles.size)
        if min(sizes) < n or (not self._ours and max(sizes) > n):
            raise DataError(
                f"{self.path}: {sizes[0]} frames, {sizes[1]} image keys and {sizes[2]} angles; expected {n} of each."
            )
        if self._ours and n > self.n:
            rows = altered_rows(self._file, self.n, n)
            self._altered |= {self.n + row for row in rows.tolist()}
        known = np.isin(keys[:n], list(FrameKind)) & (keys[:n] != FrameKind.WIDE_VIEW)  # which is never written
        self.image_key = np.where(known, keys[:n], FrameKind.INVALID).astype(np.int32)
        if self._ours and (moved := datasets.dataset(places.entry, "sample/x_translation")) is not None:
            hdf5.look_again(moved)
            self.aside_mm = datasets.values_of(moved)[:n]
            self.image_key[(self.image_key == FrameKind.ALIGNMENT) & (self.aside_mm != 0)] = FrameKind.WIDE_VIEW
        self.image_key[[*self._altered]] = FrameKind.INVALID
        self.n, self.angles = n, angles[:n]
        self.pass_ends, self.decisions = pass_ends_in(self._file), decisions_in(self._file)
        self._checksums = self._column("digest/checksum", np.empty(0))[:n] if self._ours else np.empty(0)
        seconds = self._seconds(places.detector, "count_time")
        self.exposures = np.where(seconds > 0, seconds, np.nan)  # some write 0 for what they do not know
        return n

    def _committed(self, key: h5py.Dataset) -> int:
        """The frames that the writer of our file counts; where they are more than before, their datasets are read
        anew."""
        places, committed = self._places, self._file[layout.COMMITTED]
        hdf5.look_again(committed)
        n = int(committed[()])
        if n < 0:
            raise ValueError(f"{n} frames are committed")
        if n > self.n:
            for item in {places.data, key, places.angle, places.image_key} - {None}:
                hdf5.look_again(item)
        return n

    @property
    def frame_bytes(self) -> int:
        return datasets.bytes_unpacked(self._places.data)

    @property
    @_guarded
    def finished(self) -> bool:
        if not self._ours:
            return True
        flag = self._file[layout.FINISHED]
        hdf5.look_again(flag)
        return bool(flag[()])

    @property
    @_guarded
    def attributes(self) -> dict[str, str | float | int]:
        """Further metadata: sample, title, times, status, missing triggers, why the scan ended early."""
        entry = self._places.entry
        facts: dict[str, str | float | int] = {}
        for name, where in TEXTS.items():
            value = datasets.text_at(entry, where)[: datasets.NAME]
            if value:
                facts[name] = value
        for name, where, units in NUMBERS:
            number = datasets.scalar(entry, where, units)
            if number is not None:
                facts[name] = number
        if "exposure_s" not in facts and np.isfinite(self.exposures).any():
            facts["exposure_s"] = float(np.nanmedian(self.exposures))
        if self._geometry is not None:
            facts |= self._geometry.remarks
        if self._places.angle_problem:
            facts["angles"] = f"unknown: {self._places.angle_problem}"
        if self._places.data.is_virtual:
            facts["parts"] = ", ".join(name for name, _ in drawn_on(self._places.data.id.get_create_plist()))
        if self._ours:
            ending = ending_in(self._file)
            facts |= {"status": ending.status, "missing_triggers": len(ending.missing)}
            if ending.reason:
                facts["ended"] = ending.reason
        return facts

    @property
    @_guarded
    def ending(self) -> ScanEnding:
        if not self._ours:
            return ScanEnding()
        ending = ending_in(self._file)
        return replace(ending, missing=gaps_in(self.path, self._file)) if ending.status == RUNNING else ending

    def _currents(self) -> NDArray[np.float64] | None:
        item = datasets.dataset(self._places.entry, "control/data")
        if item is None or item.dtype.kind not in "uif" or item.size < self.n:
            return None
        values = np.ravel(datasets.values_of(item))[: self.n].astype(np.float64)
        return np.where(values > 0, values, np.nan)

    def _find_stated(self, found: list[Places], turned: str) -> None:
        """What a foreign file states: fields, other scans in it, and turns of the detector."""
        self.not_used += stated_in(NXTOMO, self._places.entry, self, str(self._places.detector.name))
        for other in {str(each.data.name): each for each in found if each.data != self._places.data}.values():
            shape, where = " x ".join(map(str, other.data.shape)), str(other.data.name)
            why = f"it is another scan of this file: --data-path {where}"
            self.not_used += (NotUsed(where, f"{shape} frames", why, True),)
        if turned:
            self.not_used += (NotUsed("detector/transformations", turned, UPRIGHT, True),)

    @property
    @_guarded
    def flags(self) -> FrameFlags | None:
        flags = read_flags(self._file, self.n) if self._ours else None
        return flags if flags is not None and (self.plan or flags.flagged.any()) else None  # a copy has none to say

    @property
    @_guarded
    def times(self) -> NDArray[np.float64] | None:
        seconds = self._seconds(self._places.entry, "frame_log/time")
        seconds[[*self._altered]] = np.nan
        return seconds if np.isfinite(seconds).any() else None

    @property
    @_guarded
    def triggers(self) -> NDArray[np.int64]:
        return self._logged("trigger", count_in_blocks(self.image_key))

    @property
    @_guarded
    def framestamps(self) -> NDArray[np.int64]:
        return self._logged("framestamp", np.full(self.n, -1))

    @property
    @_guarded
    def replaces(self) -> NDArray[np.int64] | None:
        rows = self._logged("replaces", np.full(self.n, -1)) if self._ours else np.full(self.n, -1)
        require_earlier(rows)
        return rows if (rows >= 0).any() else None

    def _logged(self, name: str, default: NDArray[np.int64]) -> NDArray[np.int64]:
        """Whole numbers [frame] of the log, -1 where the record is altered."""
        rows = self._column(f"frame_log/{name}", default)[: self.n].astype(np.int64)
        rows[[*self._altered]] = -1
        return rows

    @property
    @_guarded
    def part_starts(self) -> NDArray[np.int64]:
        item = datasets.dataset(self._file, layout.PART_STARTS) if self._ours else None
        starts = np.zeros(1, np.int64) if item is None else np.ravel(datasets.values_of(item))
        if starts.dtype.kind not in "iu" or not starts.size or starts[0] != 0 or (starts[1:] <= starts[:-1]).any():
            raise DataError(f"{self.path}: {layout.PART_STARTS} is {starts}; expected ascending rows, the first 0.")
        return starts.astype(np.int64)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        if self._geometry is not None and any(self._geometry.mirrored):
            return self._mirrored(frame_indices(frames, self.n), range(self.shape[0])[rows], *self._geometry.mirrored)
        indices, height = frame_indices(frames, self.n), len(range(self.shape[0])[rows])
        out = np.empty((indices.size, height, self.shape[1]), self.dtype)
        if 2 * height < self.shape[0] or not self.checksummed:
            datasets.read_frames(self._places.data, indices, rows, out)
            return out
        for view, row in zip(out, indices, strict=True):
            view[:] = self._compared(row)[rows]
        return out

    def _mirrored(
        self, indices: NDArray[np.int64], rows: range, upside_down: bool, left_to_right: bool
    ) -> NDArray[Any]:
        kept = [self.shape[0] - 1 - row for row in rows] if upside_down else list(rows)
        first, end = (min(kept), max(kept) + 1) if kept else (0, 0)
        block = np.empty((indices.size, end - first, self.shape[1]), self.dtype)
        datasets.read_frames(self._places.data, indices, slice(first, end), block)
        return block[:, [row - first for row in kept], :: -1 if left_to_right else 1]

    def _compared(self, row: int) -> NDArray[Any]:
        whole = np.empty((1, *self.shape), self.dtype)
        datasets.read_frames(self._places.data, np.array([row]), WHOLE, whole)
        if not has_checksum(whole[0], int(self._checksums[row])):
            self._damaged.add(int(row))
        return whole[0]

    @property
    def checksummed(self) -> bool:
        return self._checksums.size == self.n > 0

    @property
    def damaged(self) -> frozenset[int]:
        return frozenset(self._damaged)

    @property
    def altered(self) -> frozenset[int]:
        return frozenset(self._altered)

    def _column(self, path: str, default: NDArray[Any]) -> NDArray[Any]:
        item = datasets.dataset(self._places.entry, path)
        if item is None:
            return default
        if self._ours:
            hdf5.look_again(item)
        values = np.asarray(datasets.values_of(item))
        return values if values.ndim == 1 and values.size >= self.n and values.dtype.kind in "ui" else default

    def _seconds(self, group: h5py.Group, path: str) -> NDArray[np.float64]:
        """Seconds of each frame; NaN where the file states none."""
        item = datasets.dataset(group, path)
        if item is not None and self._ours:
            hdf5.look_again(item)
        values = datasets.in_units(item, datasets.TIME_UNITS)
        if values is None or 1 != values.size < self.n:
            return np.full(self.n, np.nan)
        return np.full(self.n, values[0]) if values.size == 1 else values[: self.n]

    def close(self) -> None:
        self._file.close()


TEXTS = {
    "sample": "sample/name",
    "title": "title",
    "definition": "definition",
    "program": "program_name",
    "start_time": "start_time",
    "end_time": "end_time",
    "instrument": "instrument/name",
}
NUMBERS = (
    ("exposure_s", "record/exposure", datasets.TIME_UNITS),
    ("period_s", "record/period", datasets.TIME_UNITS),
    ("no_data", "record/no_data", {"": 1.0}),
    ("saturation", "instrument/detector/saturation_value", {"": 1.0}),  # as NXdetector has it
    ("saturation", "record/saturation", {"": 1.0}),
    ("distance_mm", "instrument/detector/distance", datasets.LENGTH_UNITS),
    ("source_distance_mm", "record/source_distance", datasets.LENGTH_UNITS),
    ("sample_diameter_mm", "sample/diameter", datasets.LENGTH_UNITS),
)


def _format(definition: str, program: str) -> str:
    if definition == layout.FLOAT_DEFINITION:
        return "float_projections"
    if program.startswith("GDA"):
        return "diamond_nexus"
    return "nxtomo" if definition == layout.NXTOMO else "nexus"


def _quantity(said: str, dtype: np.dtype[Any]) -> Quantity:
    if said == "line_integrals":
        return "line_integrals"
    return (
        "counts" if said == "counts" or (not said and dtype.kind in "iu") else "unknown"
    )  # NXtomo: data are integers, as detected


def _recognises(path: Path, opening: Opening) -> bool:
    if not path.is_file() or not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return bool(find(file))


FORMAT = ScanFormat(
    "an NXdetector with frames and an image_key (NXtomo)",
    _recognises,
    lambda path, opening: NXtomoSource(path, follow=opening.follow, own_angles=opening.own_angles),
)
