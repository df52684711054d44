"""Layout of this program's HDF5 scan files: every path, type and unit. All datasets are created before the first
frame and only grow afterwards.

    /entry                      NXentry, definition NXtomo (NeXus definitions 2026.01): title, start_time, end_time
      instrument/detector       data u16 [frame, row, col] (one frame a chunk), image_key, image_key_control,
                                count_time (s), x_pixel_size, y_pixel_size, distance (mm), field_of_view
      instrument/beam           incident_energy;  instrument/devices: what each device said of itself
      instrument/filter         NXattenuator: type, if there is a filter
      instrument/monochromator  NXmonochromator: energy (keV), if there is a monochromator
      sample                    name, rotation_angle (degree)
      data                      NXdata: hard links to data, rotation_angle, image_key (with @target); float axes y, x
      frame_log                 kind, trigger, framestamp, time of each frame, the row it replaces; checksum: of these,
                                of its angle, image key and count_time (record_checksums); its flags,
                                flag_scores, flag_regions and frame_valid; flag_legend: bits of the flags
      digest                    statistics of each frame, and preview f32 [frame, row, col]
      record/beam               NXlog: time, value of the beam monitor, if there is one (written at the end)
      record/part_starts        of a scan in parts: the first row of each (see storage.parts)
      record/parts              of joined.h5: name and frames of each file that it draws from
      record                    plan (JSON), config (YAML), period, axis_col, quantity, program, source_distance
      progress                  frames_committed, finished, status, missing_triggers, reason; of a scan that decides
                                after each pass: pass_ends, decisions
    /exchange                   the same frames as Data Exchange (virtual datasets, put into the group at the end)

image_key contains 0, 1, 2 or 3. An alignment frame has 3 in image_key, and -1 in frame_log/kind. image_key_control (a
link to frame_log/kind), field_of_view, and the attributes `definition` and `version` of the entry are ESRF's extensions
of NXtomo. Without them ESRF's programs (nabu) take the file for another kind of file, or leave out its darks and flats.
NXtomo allows only integers (NX_INT) as data. Frames of real numbers therefore get the same paths under another
definition, FLOAT_DEFINITION.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.installed import version
from beamline.monitor.checks import CHECKS
from beamline.monitor.digest import preview_shape
from beamline.storage.flag_legend import FLAGS, REGIONS, SCORES, VALID, write_legend
from beamline.storage.hdf5 import COMMITTED as COMMITTED
from drivers.base.frame import FrameKind
from recon.base.geometry import Geometry

# Not "latest", because that writes datatypes that HDF5 1.14 cannot open. This is the oldest version with SWMR and
# virtual datasets, so readers with HDF5 1.10 can open the files of this program.
LIBVER = ("v110", "v110")
NXTOMO = "NXtomo"
FLOAT_DEFINITION = "splatline_float_projections"
# version of the paths that nxtomo, tomoscan and nabu look for; 1.5 is the oldest version that has all paths of this
# program
ESRF_VERSION = 1.5

ENTRY = "/entry"
DETECTOR = "/entry/instrument/detector"
DATA = f"{DETECTOR}/data"
IMAGE_KEY = f"{DETECTOR}/image_key"
IMAGE_KEY_CONTROL = f"{DETECTOR}/image_key_control"
FIELD_OF_VIEW = f"{DETECTOR}/field_of_view"
ANGLE = "/entry/sample/rotation_angle"
KIND = "/entry/frame_log/kind"
X_TRANSLATION = "/entry/sample/x_translation"  # the value of `Frame.aside`; only for scans with offset projections
PREVIEW = "/entry/digest/preview"
COUNT_TIME = f"{DETECTOR}/count_time"
TRIGGER = "/entry/frame_log/trigger"
FRAMESTAMP = "/entry/frame_log/framestamp"
TIME = "/entry/frame_log/time"
REPLACES = "/entry/frame_log/replaces"
RECORD_CHECKSUM = "/entry/frame_log/checksum"
FINISHED = "/entry/progress/finished"
STATUS = "/entry/progress/status"
MISSING = "/entry/progress/missing_triggers"
REASON = "/entry/progress/reason"
PASS_ENDS = "/entry/progress/pass_ends"  # rows; only for scans that decide after each pass what to measure next
# only for these scans: one line of JSON per pass, the values of the event `next_chosen`
DECISIONS = "/entry/progress/decisions"
PART_STARTS = "/entry/record/part_starts"
EXCHANGE = "/exchange"
PARTS = "/entry/record/parts"
END_TIME = "/entry/end_time"
BEAM = "/entry/record/beam"
BEAM_TIME, BEAM_VALUE = f"{BEAM}/time", f"{BEAM}/value"
AXIS_COL = "/entry/record/axis_col"
SOURCE_DISTANCE = "/entry/record/source_distance"
"""Only in files of a cone beam. NXsource also has a distance, but synchrotrons state it although their beams are
practically parallel.
"""

_SCALARS_PER_CHUNK = 512  # 4 KiB, the smallest amount that a flush writes for each column
_MARKS_PER_CHUNK = 32  # frames per chunk of the scores and regions
REASON_BYTES = 600
FULL = "Full"
_TURN_TOLERANCE = np.radians(1.0)  # largest amount that may be missing from 360 degrees

COLUMNS: Mapping[str, tuple[str, str]] = MappingProxyType(
    {  # path: (type, unit)
        IMAGE_KEY: ("<i4", ""),
        COUNT_TIME: ("<f8", "s"),
        ANGLE: ("<f8", "degree"),
        KIND: ("<i4", ""),
        TRIGGER: ("<i8", ""),
        FRAMESTAMP: ("<i8", ""),
        TIME: ("<f8", "s"),
        REPLACES: ("<i8", ""),
        FLAGS: ("<u8", ""),
        "/entry/digest/minimum": ("<f8", ""),
        "/entry/digest/maximum": ("<f8", ""),
        "/entry/digest/mean": ("<f8", ""),
        "/entry/digest/variance": ("<f8", ""),
        "/entry/digest/sum_abs": ("<f8", ""),
        "/entry/digest/invalid_fraction": ("<f8", ""),
        "/entry/digest/saturated_fraction": ("<f8", ""),
        "/entry/digest/entropy": ("<f8", "bit"),
        "/entry/digest/checksum": ("<u4", ""),
        RECORD_CHECKSUM: ("<u4", ""),
    }
)


def growing(file: h5py.File) -> list[str]:
    """The datasets in this file that have a row for each frame, except the pixels and their preview."""
    return [*COLUMNS, VALID, SCORES, REGIONS, *(path for path in (X_TRANSLATION,) if path in file)]


RECORDED = (
    IMAGE_KEY, COUNT_TIME, ANGLE, KIND, TRIGGER, FRAMESTAMP, TIME, REPLACES,
)  # fmt: skip
"""Metadata of a frame that never change. RECORD_CHECKSUM is computed from these columns, in this order."""

Description = Mapping[str, str | int | float]


@dataclass(frozen=True)
class ScanInfo:
    """Metadata of a scan before its first frame; None if unknown.

    Attributes:
        sample: name of the sample. title: one line for people.
        pixel_size_mm: pixel size at the sample. energy_kev: photon energy. distance_mm: distance from the sample to the
            detector.
        exposure, period: exposure, and time between triggers, in s.
        axis_col: column of the rotation axis, counted from 0 at the centre of the first column.
        source_distance_mm: distance from the source to the sample; only for a cone beam (`pixel_size_mm` is then the
            size on the detector, as in NXtomo).
        plan, config: the plan as JSON and the configuration as YAML, stored as text.
        devices: the description of each device, by its name.
        filter: name of the filter that is in the beam.
        monochromator_kev: present energy of the monochromator; `energy_kev` is then the same. None: there is no
            monochromator, or its energy is not known.
        beam_unit: unit of the readings of the beam monitor; None: there is no beam monitor.
        saturation: counts at which a pixel is saturated.
        offset_views: True if offset projections are planned.
        decides: True if the scan decides after each pass what to measure next.
        diameter_mm: diameter of the sample.
    """

    sample: str
    title: str = ""
    pixel_size_mm: float | None = None
    energy_kev: float | None = None
    distance_mm: float | None = None
    exposure: float | None = None
    period: float | None = None
    axis_col: float | None = None
    source_distance_mm: float | None = None
    plan: str = "{}"
    config: str = ""
    devices: Mapping[str, Description] = field(default_factory=lambda: MappingProxyType({}))
    beam_unit: str | None = None
    filter: str | None = None
    monochromator_kev: float | None = None
    saturation: float | None = None
    offset_views: bool = False
    decides: bool = False
    diameter_mm: float | None = None


def iso_time(seconds: float) -> str:
    """ISO 8601 in UTC from seconds since the Unix epoch."""
    return datetime.fromtimestamp(seconds, UTC).isoformat(timespec="milliseconds")


def create(
    file: h5py.File,
    info: ScanInfo,
    frame_shape: tuple[int, int],
    dtype: np.dtype[Any],
    *,
    quantity: str,
    preview_bin: int,
    start: float | None,
) -> None:
    """Create every group, dataset and attribute that the file has while it grows. No frame is stored yet."""
    rows, cols = frame_shape
    definition = NXTOMO if dtype.kind in "iu" else FLOAT_DEFINITION
    _groups(file)
    file["/entry/definition"] = definition
    if start is not None:
        file["/entry/start_time"] = iso_time(start)
        _rewritable_text(file, END_TIME, "", len(iso_time(start)))
    _facts(file, info)
    file["/entry/record/quantity"] = quantity
    _columns(file, info, frame_shape, dtype, preview_bin)
    _nxdata(file, rows, cols, info.pixel_size_mm)
    file[ENTRY].attrs["definition"], file[ENTRY].attrs["version"] = definition, ESRF_VERSION
    file[IMAGE_KEY_CONTROL] = file[KIND]
    field = _field_of_view(_planned_angles(info), frame_shape, info.axis_col)
    if field or info.axis_col is not None:  # readings will state it later, but nothing can be created then
        _rewritable_text(file, FIELD_OF_VIEW, field or FULL, len(FULL))

    file[COMMITTED] = np.int64(0)
    file[FINISHED] = np.int8(0)
    _rewritable_text(file, STATUS, "running", 16)
    _rewritable_text(file, REASON, "", REASON_BYTES)
    _growing(file, MISSING, (), np.dtype("<i8"))
    file[MISSING].attrs["description"] = "triggers of the scan, counted from 0, that gave no frame"
    if info.decides:
        _growing(file, PASS_ENDS, (), np.dtype("<i8"))
        file.create_dataset(DECISIONS, (0,), h5py.string_dtype("utf-8", 8192), maxshape=(None,), chunks=(1,))


def _groups(file: h5py.File) -> None:
    """Create the groups that every scan has."""
    for path, kind in (
        (ENTRY, "NXentry"),
        ("/entry/instrument", "NXinstrument"),
        (DETECTOR, "NXdetector"),
        ("/entry/instrument/source", "NXsource"),
        ("/entry/instrument/beam", "NXbeam"),
        ("/entry/instrument/devices", "NXcollection"),
        ("/entry/sample", "NXsample"),
        ("/entry/data", "NXdata"),
        ("/entry/frame_log", "NXcollection"),
        ("/entry/digest", "NXcollection"),
        ("/entry/record", "NXcollection"),
        ("/entry/progress", "NXcollection"),
    ):
        file.create_group(path).attrs["NX_class"] = kind
    file.create_group(EXCHANGE)
    file["implements"] = "exchange"
    file.attrs["default"] = "entry"
    file[ENTRY].attrs["default"] = "data"


def _facts(file: h5py.File, info: ScanInfo) -> None:
    """Write the facts that are known before the first frame: about the sample, the beam, the plan and the devices."""
    file["/entry/title"] = info.title or info.sample
    file["/entry/sample/name"] = info.sample
    file["/entry/instrument/source/probe"] = "x-ray"
    # NXsource counts distances along the beam, from the sample.
    upstream = None if info.source_distance_mm is None else -info.source_distance_mm
    for path, value, unit in (
        (f"{DETECTOR}/x_pixel_size", info.pixel_size_mm, "mm"),
        (f"{DETECTOR}/y_pixel_size", info.pixel_size_mm, "mm"),
        (f"{DETECTOR}/distance", info.distance_mm, "mm"),
        ("/entry/instrument/source/distance", upstream, "mm"),
        (SOURCE_DISTANCE, info.source_distance_mm, "mm"),
        ("/entry/instrument/beam/incident_energy", info.energy_kev, "keV"),
        ("/entry/record/exposure", info.exposure, "s"),
        ("/entry/record/period", info.period, "s"),
        ("/entry/sample/diameter", info.diameter_mm, "mm"),
        (AXIS_COL, info.axis_col, "pixel"),
    ):
        if value is not None:
            file[path] = np.float64(value)
            file[path].attrs["units"] = unit
    if info.saturation is not None:
        file["/entry/record/saturation"] = np.float64(info.saturation)
    for name, text in (("plan", info.plan), ("config", info.config), ("program", f"splatline {version()}")):
        file[f"/entry/record/{name}"] = text
    if info.filter is not None:
        file.create_group("/entry/instrument/filter").attrs["NX_class"] = "NXattenuator"
        file["/entry/instrument/filter/type"] = info.filter
    if info.monochromator_kev is not None:
        file.create_group("/entry/instrument/monochromator").attrs["NX_class"] = "NXmonochromator"
        file["/entry/instrument/monochromator/energy"] = np.float64(info.monochromator_kev)
        file["/entry/instrument/monochromator/energy"].attrs["units"] = "keV"
    for device, description in info.devices.items():
        group = file.create_group(f"/entry/instrument/devices/{device.replace('/', '_')}")
        group.attrs["NX_class"] = "NXcollection"
        for key, fact in description.items():
            group[key.replace("/", "_")] = fact


def _columns(
    file: h5py.File, info: ScanInfo, frame_shape: tuple[int, int], dtype: np.dtype[Any], preview_bin: int
) -> None:
    """Create the datasets that grow with the frames or with the readings of the beam monitor."""
    _growing(file, DATA, frame_shape, dtype)
    _growing(file, PREVIEW, preview_shape(frame_shape, preview_bin), np.dtype("<f4"))
    file[PREVIEW].attrs["bin"] = np.int64(preview_bin)
    wide = {X_TRANSLATION: ("<f8", "mm")} if info.offset_views else {}
    for path, (kind, unit) in {**COLUMNS, **wide}.items():
        _growing(file, path, (), np.dtype(kind))
        if unit:
            file[path].attrs["units"] = unit
    _growing(file, VALID, (), np.dtype("<u1"))
    _growing(file, SCORES, (len(CHECKS),), np.dtype("<f4"), _MARKS_PER_CHUNK)
    _growing(file, REGIONS, (len(CHECKS), 4), np.dtype("<i4"), _MARKS_PER_CHUNK)
    write_legend(file)
    file[TIME].attrs["description"] = "since 1970-01-01T00:00:00Z, at the trigger"
    if info.beam_unit is not None:
        file.create_group(BEAM).attrs["NX_class"] = "NXlog"
        for name, unit in (("time", "s"), ("value", info.beam_unit)):
            _growing(file, f"{BEAM}/{name}", (), np.dtype("<f8"))
            file[f"{BEAM}/{name}"].attrs["units"] = unit
        file[f"{BEAM}/time"].attrs["description"] = "since 1970-01-01T00:00:00Z"


def state_field_of_view(file: h5py.File) -> None:
    """Write whether each projection of a 360-degree scan shows only half of the sample, as far as this is known."""
    field = field_of_view(file)
    if field and FIELD_OF_VIEW in file:
        file[FIELD_OF_VIEW][()] = field.encode()
    elif field:
        _rewritable_text(file, FIELD_OF_VIEW, field, len(FULL))


def field_of_view(file: h5py.File) -> str:
    """`Half` if each projection of a 360-degree scan shows only half of the sample; "" if the angles or the axis are
    unknown.
    """
    angles = np.radians(file[ANGLE][()][file[KIND][()] == FrameKind.PROJECTION])
    axis_col = float(file[AXIS_COL][()]) if AXIS_COL in file else None
    return _field_of_view(angles, file[DATA].shape[1:], axis_col)


def _planned_angles(info: ScanInfo) -> NDArray[np.float64]:
    """Angles of the planned projections, in radians; unknown if the plan does not state them."""
    try:
        return np.radians(np.asarray(json.loads(info.plan)["angles_deg"], np.float64))
    except (ValueError, LookupError, TypeError):  # the plan of another program, or no plan
        return np.array([np.nan])


def _field_of_view(angles: NDArray[np.float64], frame_shape: tuple[int, ...], axis_col: float | None) -> str:
    """`Half` if each projection of a 360-degree scan shows only half of the sample; "" if the angles or the axis are
    unknown.
    """
    if not np.isfinite(angles).all():
        return ""
    if angles.size < 2 or np.ptp(angles) * angles.size / (angles.size - 1) < 2 * np.pi - _TURN_TOLERANCE:
        return FULL
    if axis_col is None:
        return ""
    geometry = Geometry.parallel(angles, (frame_shape[0], frame_shape[1]), axis_col=axis_col)
    return "Half" if geometry.is_off_middle else FULL


def _rewritable_text(file: h5py.File, path: str, value: str, width: int) -> None:
    """Text with a fixed length, because text with a variable length cannot be read if it is written under SWMR (h5py
    issue 1273).
    """
    file.create_dataset(path, data=value.encode(), dtype=h5py.string_dtype("utf-8", width))


def _growing(file: h5py.File, path: str, item: tuple[int, ...], dtype: np.dtype[Any], rows: int = 1) -> None:
    chunks = (rows, *item) if item else (_SCALARS_PER_CHUNK,)
    file.create_dataset(path, (0, *item), dtype, maxshape=(None, *item), chunks=chunks)


def _nxdata(file: h5py.File, rows: int, cols: int, pixel_size_mm: float | None) -> None:
    group = file["/entry/data"]
    group.attrs["signal"] = "data"
    group.attrs["axes"] = ["rotation_angle", "y", "x"]
    for path in (DATA, ANGLE, IMAGE_KEY):
        file[path].attrs["target"] = path  # NeXus recognises a link by its attribute `target`
        group[path.rsplit("/", 1)[1]] = file[path]
    for name, n in (("y", rows), ("x", cols)):
        group[name] = np.arange(n) * (1.0 if pixel_size_mm is None else pixel_size_mm)
        group[name].attrs["units"] = "pixel" if pixel_size_mm is None else "mm"
    for index, name in enumerate(("rotation_angle", "y", "x")):
        group.attrs[f"{name}_indices"] = np.int64(index)
