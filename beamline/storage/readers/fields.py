"""Lists the fields in files of other programs that affect geometry, units, frame order or validity, and how each field
is used.

`NXTOMO` and `EXCHANGE` are the lists behind docs/scan_files.md. A reader calls `stated_in` to find the fields that a
file states but no reader uses. `info` shows these fields, and `validate` warns if such a value may change the volume.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.text import printable
from beamline.storage import datasets
from beamline.storage.readers.base import NotUsed, ScanSource

Matters = Callable[[NDArray[Any], h5py.Dataset, ScanSource], bool]
"""Whether a value [...] of a dataset may change the volume of a scan that is read without it."""

EXCHANGE_LENGTH_UNITS = {**datasets.LENGTH_UNITS, "": 1e3}  # the format prescribes metres if no unit is stated
EXCHANGE_ENERGY_UNITS = {**datasets.ENERGY_UNITS, "": datasets.ENERGY_UNITS["j"]}
EXCHANGE_TIME_UNITS = {**datasets.TIME_UNITS, "": 1.0}  # the format prescribes seconds if no unit is stated
# px, below which a displacement is not visible; relative error of a length, above which the volume is wrong
_HALF_PIXEL, _WRONG = 0.5, 0.01


@dataclass(frozen=True)
class Entry:
    """A field of a file format.

    Attributes:
        where: path of the field below the entry, or below the root of a Data Exchange file; "detector/" stands for the
            detector that is read.
        use: how this program uses the field. If `used` is False: why its value changes nothing, or what the user can
            do.
        used: True if this program reads the field.
        units: the known units of a number that is used.
        matters: for a field that is not used: function that returns whether its value may change the volume. None: no
            value can.
    """

    where: str
    use: str
    used: bool = True
    matters: Matters | None = None
    units: Mapping[str, float] | None = None


def stated_in(fields: Sequence[Entry], root: h5py.Group, source: ScanSource, detector: str = "") -> tuple[NotUsed, ...]:
    """The fields that a file states and that are not used. A value that may change the volume is marked as a doubt.

    A number whose unit is unknown cannot be used, so it is listed, too.
    """
    frames, views = len(source.table), source.table.views
    unused = list[NotUsed]()
    for field in fields:
        item = _dataset(root, field.where, detector) if field.units is not None or not field.used else None
        if item is None or item.size == 0:
            continue
        # excludes positions, times and numbers that belong to each frame
        if item.size * item.dtype.itemsize > datasets.BRIEF:
            unused.append(NotUsed(field.where, f"{' x '.join(map(str, item.shape))} values", "it is too large", False))
            continue
        value, reason, doubt, share = np.asarray(datasets.values_of(item)), field.use, True, 0.0
        if not field.used:
            doubt = field.matters is not None and field.matters(value, item, source)
        elif value.size not in (1, frames, views.size):
            reason = f"the field has {value.size} values, but the scan has {frames} frames"
        else:
            varying, share = _varying(field, item, source)
            reason = _unit_problem(field, value, item, source) or varying
        if reason:
            text = _text(value, datasets.attribute(item, "units"))
            unused.append(NotUsed(field.where, text, reason, doubt, share > _WRONG))
    return tuple(unused)


def _unit_problem(field: Entry, value: NDArray[Any], item: h5py.Dataset, source: ScanSource) -> str:
    """A text that says that a number cannot be used because its unit is unknown; "" if the unit is known, or no number
    is stated.
    """
    stated = datasets.text(value) if value.dtype.kind in "SO" else _true(value, item, source)
    if field.units is None or not stated or datasets.in_units(item, field.units) is not None:
        return ""
    if value.dtype.kind not in "uifb":
        return "the field is text; expected a number, with a known unit after the number or in the attribute `units`"
    unit = datasets.attribute(item, "units")
    return f"its units {unit!r} are not known here" if unit else "it has no attribute `units`, so its unit is unknown"


def _varying(field: Entry, item: h5py.Dataset, source: ScanSource) -> tuple[str, float]:
    """The effect of using one length for all projections although the file states other lengths for some, and the share
    of these projections. "" if the effect is not visible.
    """
    lengths = None if field.units is None or "mm" not in field.units else datasets.in_units(item, field.units)
    if lengths is None or lengths.size == 1:
        return "", 0.0
    lengths = lengths[source.table.views] if lengths.size == len(source.table) else lengths
    typical = np.median(lengths)
    whole = typical if "pixel_size" in field.where else np.inf if source.cone is None else source.cone[1]
    share = float(np.max(np.abs(lengths - typical)) / whole)
    moved = share * max(source.shape) / 2  # px at the edge of the field of view
    return (_ONE.format(moved), share) if moved > _HALF_PIXEL else ("", 0.0)


def _dataset(root: h5py.Group, where: str, detector: str) -> h5py.Dataset | None:
    if where.startswith("detector/"):
        where = f"{detector}/{where.removeprefix('detector/')}"
    return datasets.dataset(root, where)


def _text(value: NDArray[Any], units: str) -> str:
    if value.size == 1:
        first = value.reshape(-1)[0]
        text = f"{first:.6g}" if value.dtype.kind == "f" else datasets.text(first)
    elif value.dtype.kind in "uif" and value.size and value.ndim == 1:
        text = f"{np.nanmin(value):.6g} to {np.nanmax(value):.6g}" if np.isfinite(value).any() else "nan"
    else:
        text = " x ".join(map(str, value.shape)) + " values"
    return printable(f"{text} {units}".strip())


def _true(value: NDArray[Any], item: h5py.Dataset, source: ScanSource) -> bool:
    return value.dtype.kind in "uifb" and bool(np.nan_to_num(value.astype(np.float64)).any())


def _moves(value: NDArray[Any], item: h5py.Dataset, source: ScanSource) -> bool:
    """True if the positions of frames differ between projections by more than half a pixel; in an unknown unit, by any
    amount.
    """
    factor = datasets.factor_of(datasets.attribute(item, "units"), datasets.LENGTH_UNITS)
    if value.dtype.kind not in "uif" or value.size != len(source.table):
        return False
    places = value.reshape(-1)[source.table.views].astype(np.float64)
    span = float(np.ptp(places)) if places.size and np.isfinite(places).all() else 0.0
    if factor is None or source.pixel_size_mm is None:
        return span > 0
    return span * factor > _HALF_PIXEL * source.pixel_size_mm


def _shifts(value: NDArray[Any], item: h5py.Dataset, source: ScanSource) -> bool:
    return value.dtype.kind in "uif" and value.size > 0 and float(np.ptp(value.astype(np.float64))) > _HALF_PIXEL


def _disagrees(value: NDArray[Any], item: h5py.Dataset, source: ScanSource) -> bool:
    """True if the optical magnification differs from 1 by more than 1 %. It is then unclear whether the pixel sizes in
    the file include it.
    """
    return value.dtype.kind in "uif" and value.size == 1 and abs(float(value.reshape(-1)[0]) - 1) > 0.01


_ONE = (
    "the value differs between projections, so the images differ in size, by up to {:.2g} px at the edge of the field "
    "of view, but one value is used for all projections. Scale the images about the rotation axis to one pixel size, "
    "or state the right pixel size with --pixel-size-um (cone beam: --cone)"
)
_POSES = "give the shifts of the projections with --poses"
_POINTS = (
    "NeXus does not define the direction of this translation on the detector; state the direction with "
    "--poses FILE:x,-y"
)
UPRIGHT = "the detector is assumed to be perpendicular to the beam"
_ENERGY = "energy, if the beams above state none"
_WAVELENGTH = "energy, if no beam states one"
_DONE = (
    "frames are corrected as if they were raw. If the frames were corrected before, give --quantity line-integrals, "
    "or use the raw frames"
)

NXTOMO: tuple[Entry, ...] = (
    Entry("definition", "not needed: the kind of the file is recognised by its structure"),
    Entry("detector/data", "frames [frame, row, col]; the attribute `axes` of NXdata must not state another order"),
    Entry("detector/image_key", "kind of each frame; a frame with an undefined code is invalid"),
    Entry(
        "detector/image_key_control", "the same codes as image_key, and -1 for an alignment frame; overrides image_key"
    ),
    Entry("detector/count_time", "exposure time of each frame", units=datasets.TIME_UNITS),
    Entry(
        "detector/x_pixel_size",
        "width of a pixel: at the sample (parallel beam) or on the detector (cone beam)",
        units=datasets.LENGTH_UNITS,
    ),
    Entry(
        "detector/y_pixel_size",
        "height of a pixel. In a parallel beam, this height is also the distance between slices; in other beams, "
        "pixels must be square",
        units=datasets.LENGTH_UNITS,
    ),
    Entry(
        "sample/x_pixel_size",
        "width of a pixel at the sample; overrides the width of the detector pixel",
        units=datasets.LENGTH_UNITS,
    ),
    Entry(
        "sample/y_pixel_size",
        "height of a pixel at the sample; overrides the height of the detector pixel",
        units=datasets.LENGTH_UNITS,
    ),
    Entry(
        "detector/distance",
        "distance from sample to detector, for the phase filter and the magnification of a cone beam",
        units=datasets.LENGTH_UNITS,
    ),
    Entry(
        "instrument/source/distance",
        "distance from source to sample; its sign and the name of the NXsource do not matter. With this distance, "
        "the beam is a cone, unless the magnification is below 1 % and all rays of the field of view are parallel to "
        "within half a "
        "pixel",
        units=datasets.LENGTH_UNITS,
    ),
    Entry("detector/x_flipped", "frames are mirrored left to right when they are read"),
    Entry("detector/y_flipped", "frames are mirrored top to bottom when they are read"),
    Entry(
        "detector/transformations",
        "if an axis is rotated by 180° (relative to `gravity`), the frames are mirrored; a warning names other "
        "rotations",
    ),
    Entry(
        "sample/rotation_angle", "angle of each frame, in its `units`; without units the command stops with an error"
    ),
    Entry(
        "sample/depends_on",
        "if sample/rotation_angle is missing: the only rotation in this chain of transformations that changes "
        "during the scan",
    ),
    Entry("sample/name", "name in reports"),
    Entry("title", "name in reports"),
    Entry("start_time", "shown by `info`"),
    Entry("end_time", "shown by `info`"),
    Entry("instrument/name", "shown by `info`"),
    Entry("control/data", "ring current, or another beam monitor, of each frame; used with --ring-current use"),
    Entry("instrument/beam/incident_energy", "energy", units=datasets.ENERGY_UNITS),
    Entry("beam/incident_energy", _ENERGY, units=datasets.ENERGY_UNITS),
    Entry("sample/beam/incident_energy", _ENERGY, units=datasets.ENERGY_UNITS),
    Entry("instrument/beam/incident_wavelength", _WAVELENGTH, units=datasets.WAVELENGTH_UNITS),
    Entry("beam/incident_wavelength", _WAVELENGTH, units=datasets.WAVELENGTH_UNITS),
    Entry("sample/beam/incident_wavelength", _WAVELENGTH, units=datasets.WAVELENGTH_UNITS),
    Entry("instrument/monochromator/energy", "energy, if no beam states one", units=datasets.ENERGY_UNITS),
    Entry(
        "instrument/monochromator/wavelength",
        "energy, if nothing else states it",
        units=datasets.WAVELENGTH_UNITS,
    ),
    Entry(
        "detector/x_rotation_axis_pixel_position",
        "the origin of this field is not defined; the axis is found in the projections, or given with --axis",
        False,
    ),
    Entry("detector/y_rotation_axis_pixel_position", "the origin of this field is not defined", False),
    Entry(
        "detector/estimated_cor_from_motor",
        "the origin of this field is not defined; the axis is found in the projections, or given with --axis",
        False,
    ),
    Entry("detector/field_of_view", "the projections show whether the scan is a half acquisition", False),
    Entry("detector/half_acquisition", "the projections show whether the scan is a half acquisition", False),
    Entry(
        "detector/beam_center_x",
        "the central ray of a cone is assumed to meet the rotation axis; --axis states its column",
        False,
    ),
    Entry(
        "detector/beam_center_y",
        "the central ray of a cone is assumed to meet the middle row; --central-row states its row",
        False,
    ),
    Entry("detector/x_pixel_offset", "pixels are assumed to be evenly spaced", False),
    Entry("detector/y_pixel_offset", "pixels are assumed to be evenly spaced", False),
    Entry(
        "detector/magnification",
        "pixel sizes are used as stated; give --pixel-size-um if these sizes are not valid at the sample",
        False,
        _disagrees,
    ),
    Entry("detector/polar_angle", UPRIGHT, False, _true),
    Entry("detector/azimuthal_angle", UPRIGHT, False, _true),
    Entry("detector/x_translation", _POINTS, False, _moves),
    Entry("detector/y_translation", _POINTS, False, _moves),
    Entry("sample/x_translation", _POINTS, False, _moves),
    Entry("sample/y_translation", _POINTS, False, _moves),
    Entry("sample/z_translation", _POINTS, False, _moves),
    Entry("sample/distance", "the sample is assumed to be at the rotation axis", False),
    Entry(
        "sample/propagation_distance",
        "the propagation distance follows from the distances of source and detector",
        False,
    ),
    Entry("sample/polar_angle", "the rotation axis is assumed to lie along the columns", False, _true),
    Entry("detector/flatfield_applied", _DONE, False, _true),
    Entry("detector/pixel_mask_applied", "defective pixels are found in the frames", False),
    Entry(
        "detector/pixel_mask",
        "in frames of whole numbers, pixels that are not 0 in this mask are filled; other defective pixels are found "
        "in the frames",
    ),
    Entry("detector/flatfield", "flats are the frames with image_key 1", False),
    Entry("detector/angular_calibration_applied", "frames are used as they are", False, _true),
    Entry("detector/countrate_correction_applied", "frames are used as they are", False),
    Entry("detector/saturation_value", "saturation is found in the frames", False),
    Entry("detector/underload_value", "frames are used as they are", False),
    Entry("detector/bit_depth_readout", "saturation is found in the frames", False),
    Entry("detector/sequence_number", "frames are used in the order of the file", False),
    Entry("detector/frame_start_number", "frames are used in the order of the file", False),
    Entry("detector/real_x_pixel_size", "x_pixel_size is used", False),
    Entry("detector/real_y_pixel_size", "y_pixel_size is used", False),
)

EXCHANGE: tuple[Entry, ...] = (
    Entry("implements", "shown by `info`"),
    Entry("exchange/data", "projections; the attribute `axes` states the order of the dimensions (default theta:y:x)"),
    Entry(
        "exchange/data_white",
        "flats; its own attribute `axes` states the order of the dimensions (default: the order of exchange/data)",
    ),
    Entry(
        "exchange/data_dark",
        "darks; its own attribute `axes` states the order of the dimensions (default: the order of exchange/data)",
    ),
    Entry(
        "exchange/theta",
        "angle of each projection, in its `units` (default degrees). If theta is missing, `start` and `step` in "
        "`process/acquisition/rotation` are used, or the attributes `rotation_start` and `rotation_step` of exchange "
        "or data",
    ),
    Entry("exchange/title", "name in reports"),
    Entry("measurement/sample/name", "name in reports"),
    Entry(
        "measurement/instrument/monochromator/energy",
        "energy, in its `units` (default joule, as the format defines)",
        units=EXCHANGE_ENERGY_UNITS,
    ),
    Entry(
        "measurement/instrument/detector/x_pixel_size",
        "width of a pixel on the detector, in its `units` (default metre, as the format defines). This width is "
        "multiplied by x_binning and divided by objective/magnification",
        units=EXCHANGE_LENGTH_UNITS,
    ),
    Entry(
        "measurement/instrument/detector/y_pixel_size",
        "height of a pixel, as x_pixel_size",
        units=EXCHANGE_LENGTH_UNITS,
    ),
    Entry(
        "measurement/instrument/detector/x_binning",
        "number of detector columns that are binned to one column of the data",
    ),
    Entry(
        "measurement/instrument/detector/y_binning", "number of detector rows that are binned to one row of the data"
    ),
    Entry("measurement/instrument/detector/objective/magnification", "gives the pixel size at the sample"),
    Entry("exchange/theta_white", "angles of the flats; each projection is then corrected with the flats around it"),
    Entry("exchange/theta_dark", "angles of the darks"),
    Entry("exchange/data_shift_x", _POSES, False, _shifts),
    Entry("exchange/data_shift_y", _POSES, False, _shifts),
    Entry("exchange/x", "pixels are assumed to be evenly spaced; x_pixel_size is used", False),
    Entry("exchange/y", "pixels are assumed to be evenly spaced; y_pixel_size is used", False),
    Entry(
        "measurement/instrument/source/energy",
        "this field is the energy of the storage ring, not of the photons",
        False,
    ),
    Entry("measurement/instrument/source/current", "the file has only one value for the whole scan", False),
    Entry(
        "measurement/instrument/detector/exposure_time",
        "exposure time of darks, flats and projections, or of each projection (default unit: seconds)",
        units=EXCHANGE_TIME_UNITS,
    ),
    Entry(
        "process/acquisition/flat_fields/flat_exposure_time",
        "exposure time of flats, if different_flat_exposure says that the flats have another exposure time (default "
        "unit: seconds)",
        units=EXCHANGE_TIME_UNITS,
    ),
    Entry(
        "process/acquisition/flat_fields/flat_field_mode",
        "`Both` means that flats were taken before and after the projections",
    ),
    Entry(
        "process/acquisition/flat_fields/num_flat_fields",
        "number of flats in a group; used if flat_field_mode is `Both` and data_white has twice this number of flats",
    ),
    Entry(
        "process/acquisition/flat_fields/different_flat_exposure",
        "`Different` means that flats have flat_exposure_time",
    ),
    Entry("measurement/instrument/detector/roi/x1", "columns count from the first column in the data", False),
    Entry("measurement/instrument/detector/roi/y1", "rows count from the first row in the data", False),
    Entry("measurement/instrument/detector/geometry/translation/distances", UPRIGHT, False),
    Entry("measurement/instrument/detector/geometry/orientation/value", UPRIGHT, False),
    Entry("measurement/sample/geometry/translation/distances", _POSES, False),
    Entry(
        "measurement/sample/geometry/orientation/value", "the rotation axis is assumed to lie along the columns", False
    ),
    Entry(
        "measurement/instrument/interferometer/number_of_grid_steps",
        "the phase steps are not combined",
        False,
        _disagrees,
    ),
    Entry(
        "measurement/instrument/detection_system/objective/resolution",
        "this field is not part of the format; give the pixel size with --pixel-size-um",
        False,
    ),
    Entry("process/acquisition/rotation/start", "theta is used", False),
    Entry("process/acquisition/rotation/step", "theta is used", False),
)
