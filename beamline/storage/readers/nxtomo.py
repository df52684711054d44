"""NexusSource: a scan with the structure of NXtomo, as ESRF and Diamond write it. Files of this program are read by
`own_scan`.

Files are recognised by their structure, an NXdetector with `data` [frame, row, col] and `image_key`, wherever the entry
is.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import DataError
from beamline.core.text import count
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import holds_arrays
from beamline.storage.datasets import require_real
from beamline.storage.frame_table import FrameTable, kinds_of
from beamline.storage.readers.base import (
    WHOLE,
    NamedArrays,
    NotUsed,
    Opening,
    Quantity,
    ScanFormat,
    ScanSource,
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
from beamline.storage.superblock import marked_as_being_written
from beamline.storage.writers import layout
from drivers.base.frame import FrameKind
from recon.base.arrays import Mask


class NexusSource(ScanSource):
    """A scan with the structure of NXtomo; see ScanSource."""

    def __init__(self, path: Path, file: h5py.File, own_angles: bool = True, data: str | None = None) -> None:
        """Read the open file. `own_angles` False: the caller supplies the angles, so the file need not contain angles,
        or their unit.

        `data`: path of the frames, if the file has several detectors. None: the frames of the only detector, or of the
            default in the file.
        """
        self.path, self._file, self._own_angles, self.n = path, file, own_angles, 0
        self._mirrored_by, self._remarks = (False, False), dict[str, str]()
        detectors = find(file)
        self._places = places = choose(file, detectors, data)
        self._check()
        shape = places.data.shape
        self.shape = (int(shape[1]), int(shape[2]))
        self.dtype = places.data.dtype
        self.format = format_of(places.entry)
        self.quantity = quantity_of(datasets.text_at(file, "/entry/record/quantity"), places.data.id.dtype)
        self.energy_kev = read_energy(places.entry)
        # NXtomo's x_rotation_axis_pixel_position is not read: some programs count it from the edge, others from the
        # middle.
        self.axis_col = datasets.scalar(file, "/entry/record/axis_col", {"pixel": 1.0})
        geometry = read_geometry(places)
        self._mirrored_by, self._remarks, self.cone = geometry.mirrored, geometry.remarks, geometry.cone
        self.central_ray = geometry.central_ray
        self.pixel_size_mm, height = geometry.pixel_mm
        self.row_pitch_mm = differing(height, self.pixel_size_mm)
        self.pixel_mask = self._mask()
        self.refresh()
        self._find_unused(detectors if data is None else [], geometry.turned)

    def _mask(self) -> Mask | None:
        """The pixels that the mask of NXdetector marks for any reason. None if there is no mask with the shape of the
        frames.
        """
        item = datasets.dataset(self._places.detector, "pixel_mask")
        if item is None or item.shape[-2:] != self.shape or item.dtype.kind not in "uib":
            return None
        if item.size != self.shape[0] * self.shape[1]:
            return None
        mask = np.asarray(datasets.values_of(item)).reshape(self.shape) != 0
        upside_down, left_to_right = self._mirrored_by
        return mask[:: -1 if upside_down else 1, :: -1 if left_to_right else 1]

    def _check(self) -> None:
        for item in (self._places.data, self._places.keys):
            require_real(item.dtype, f"{item.name} in {self.path}")
        self.unpack_bytes = datasets.require_possible(self._places.data)
        require_order(self._places)
        lost = datasets.missing_links(self._places.data) + datasets.missing_links(self._places.keys)
        if lost:
            linked_file = lost[0]
            raise DataError(
                f"{self.path} refers to frames in {linked_file}, which does not exist or has another shape "
                f"({count(len(lost), 'such link')})."
            )

    @property
    def finished(self) -> bool:
        return not any(map(marked_as_being_written, {self.path, Path(self._places.data.file.filename)}))

    @hdf5.guarded
    def refresh(self) -> int:
        places, keys, ended = self._places, self._places.keys, self.finished
        hdf5.look_again(keys)
        angle = places.angle if self._own_angles else None
        n_written = [hdf5.n_written(each) for each in (places.data, angle) if each is not None]
        n = len(places.data) if ended else min(*n_written, len(keys))
        angles = np.full(n, np.nan) if angle is None else places.sense * datasets.radians(angle) + 0.0  # avoids -0
        kinds = kinds_of(np.ravel(datasets.values_of(keys)))
        sizes = (int(places.data.shape[0]), kinds.size, angles.size)
        if min(sizes) < n or (ended and max(sizes) > n):
            n_frames = sizes[0]
            n_keys = sizes[1]
            n_angles = sizes[2]
            raise DataError(
                f"{self.path}: {n_frames} frames, {n_keys} image keys and {n_angles} angles; expected {n} of each."
            )
        self.n = n
        seconds, times = self._seconds(places.detector, "count_time"), self._seconds(places.entry, "frame_log/time")
        exposures = np.where(seconds > 0, seconds, np.nan)  # some programs write 0 for an unknown value
        logged = {f"{name}s": self._column(f"frame_log/{name}") for name in ("trigger", "framestamp")}
        own = {name: column for name, column in logged.items() if column is not None}
        self.table = FrameTable.of(
            kinds[:n],
            angles[:n],
            exposures,
            times=times if np.isfinite(times).any() else None,
            energies=read_energies(places.entry, n),
            currents=self._currents(),
            **own,
        )
        return n

    @property
    def frame_bytes(self) -> int:
        return datasets.bytes_unpacked(self._places.data)

    @property
    @hdf5.guarded
    def attributes(self) -> dict[str, str | float | int]:
        """Further metadata: sample, title, times."""
        facts = stated_facts(self._places.entry, self.table.exposures)
        facts |= self._remarks
        where, against = str(getattr(self._places.angle, "name", "")), self._places.sense < 0
        if self._places.angle_problem:
            facts["angles"] = f"unknown: {self._places.angle_problem}"
        elif self._own_angles and (against or not where.endswith("/rotation_angle")):
            facts["angles_reversed" if against else "angles_from"] = where
        if self._places.data.is_virtual:
            facts["parts"] = ", ".join(name for name, _ in drawn_on(self._places.data.id.get_create_plist()))
        return facts

    def _currents(self) -> NDArray[np.float64] | None:
        item = datasets.dataset(self._places.entry, "control/data")
        if item is None or item.dtype.kind not in "uif" or item.size < self.n:
            return None
        values = np.ravel(datasets.values_of(item))[: self.n].astype(np.float64)
        return np.where(values > 0, values, np.nan)

    def _find_unused(self, detectors: list[Places], turned: str) -> None:
        """Find the fields, other scans and rotations of the detector that the file states and that are not used."""
        self.not_used += stated_in(NXTOMO, self._places.entry, self, str(self._places.detector.name))
        for other in {str(each.data.name): each for each in detectors if each.data != self._places.data}.values():
            shape, where = " x ".join(map(str, other.data.shape)), str(other.data.name)
            reason = f"these frames belong to another scan in the file; --data-path {where} selects this scan"
            self.not_used += (NotUsed(where, f"{shape} frames", reason, True),)
        if turned:
            self.not_used += (NotUsed("detector/transformations", turned, UPRIGHT, True),)

    def read(self, frames: slice | ArrayLike, rows: slice = WHOLE) -> NDArray[Any]:
        indices, (upside_down, left_to_right) = frame_indices(frames, self.n), self._mirrored_by
        kept = range(self.shape[0])[rows]
        if upside_down or left_to_right:
            return self._mirrored(indices, kept, upside_down, left_to_right)
        out = np.empty((indices.size, len(kept), self.shape[1]), self.dtype)
        datasets.read_frames(self._places.data, indices, rows, out)
        return out

    def _mirrored(
        self, indices: NDArray[np.int64], rows: range, upside_down: bool, left_to_right: bool
    ) -> NDArray[Any]:
        kept = [self.shape[0] - 1 - row for row in rows] if upside_down else list(rows)
        first, end = (min(kept), max(kept) + 1) if kept else (0, 0)
        block = np.empty((indices.size, end - first, self.shape[1]), self.dtype)
        datasets.read_frames(self._places.data, indices, slice(first, end), block)
        return block[:, [row - first for row in kept], :: -1 if left_to_right else 1]

    def _column(self, path: str) -> NDArray[np.int64] | None:
        """Integers [frame]; None if the file has no such list."""
        item = datasets.dataset(self._places.entry, path)
        values = None if item is None else np.asarray(datasets.values_of(item))
        if values is None or values.ndim != 1 or values.size < self.n or values.dtype.kind not in "ui":
            return None
        return values[: self.n].astype(np.int64)

    def _seconds(self, group: h5py.Group, path: str) -> NDArray[np.float64]:
        """Time of each frame in s; NaN if the file states no times."""
        values = datasets.in_units(datasets.dataset(group, path), datasets.TIME_UNITS)
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
    ("saturation", "instrument/detector/saturation_value", {"": 1.0}),  # as NXdetector stores it
    ("saturation", "record/saturation", {"": 1.0}),
    ("distance_mm", "instrument/detector/distance", datasets.LENGTH_UNITS),
    ("source_distance_mm", "record/source_distance", datasets.LENGTH_UNITS),
    ("sample_diameter_mm", "sample/diameter", datasets.LENGTH_UNITS),
)


def stated_facts(entry: h5py.Group, exposures: NDArray[np.float64]) -> dict[str, str | float | int]:
    """The facts of a scan in an entry: sample, title, times, distances, exposure."""
    facts: dict[str, str | float | int] = {}
    for name, path in TEXTS.items():
        value = datasets.text_at(entry, path)[: datasets.NAME]
        if value:
            facts[name] = value
    for name, path, units in NUMBERS:
        number = datasets.scalar(entry, path, units)
        if number is not None:
            facts[name] = number
    if "exposure_s" not in facts and np.isfinite(exposures).any():
        facts["exposure_s"] = float(np.nanmedian(exposures))
    return facts


def format_of(entry: h5py.Group) -> str:
    """The name of the format of an entry."""
    definition = datasets.text_at(entry, "definition") or datasets.attribute(entry, "definition")
    if definition == layout.FLOAT_DEFINITION:
        return "float_projections"
    if datasets.text_at(entry, "program_name").startswith("GDA"):
        return "diamond_nexus"
    return "nxtomo" if definition == layout.NXTOMO else "nexus"


def quantity_of(stated: str, dtype: np.dtype[Any]) -> Quantity:
    """The quantity of the pixels: from the text in a file of this program, otherwise from the type of the pixels."""
    if stated == "line_integrals":
        return "line_integrals"
    return (
        "counts" if stated == "counts" or (not stated and dtype.kind in "iu") else "unknown"
    )  # In NXtomo, data are integers as the detector counts them.


def open_nxtomo(path: Path, *, follow: bool = False, own_angles: bool = True, data: str | None = None) -> NexusSource:
    """Open a file of another program; arguments as for `NexusSource`."""
    file = hdf5.open_hdf5(path, follow)
    with hdf5.closed_on_error(file):
        return NexusSource(path, file, own_angles, data)


def _recognises(path: Path, opening: Opening) -> bool:
    if not path.is_file() or not hdf5.is_hdf5(path, opening.follow):
        return False
    with hdf5.open_hdf5(path, opening.follow) as file:
        return bool(find(file))


def _scan_of_arrays(path: Path, arrays: NamedArrays) -> NexusSource | None:
    """The scan of the detector to which these frames belong."""
    if not arrays.alone or holds_arrays(path):
        return None
    with hdf5.open_hdf5(path) as file:
        named = datasets.dataset(file, arrays.data)
        keyed = named is not None and any(places.data == named for places in find(file))
    return open_nxtomo(path, own_angles=arrays.own_angles, data=arrays.data) if keyed else None


def _references(path: Path, file: h5py.File, kind: FrameKind) -> NexusSource | None:
    for places in find(file):
        if (places.kinds() == kind).any():
            return open_nxtomo(path, own_angles=False, data=str(places.data.name))
    return None


FORMAT = ScanFormat(
    "an NXdetector with frames and an image_key (NXtomo)",
    _recognises,
    lambda path, opening: open_nxtomo(path, follow=opening.follow, own_angles=opening.own_angles),
    _scan_of_arrays,
    _references,
)
