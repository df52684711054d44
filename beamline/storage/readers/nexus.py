"""Finds facts in NeXus files: the detector with its frames and image keys, angles, pixel size, energy, a cone beam, and
mirrored frames.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import datasets
from beamline.storage.frame_table import kinds_of
from beamline.storage.readers.orders import order_of_axes

_LISTED = 6  # most detectors, or lists of angles, that a sentence names
_LONGEST = 100  # most steps of a chain of transformations


@dataclass(frozen=True, eq=False)
class Places:
    """The objects in a file that are read; None for a missing object.

    `sense` is -1 if the angles increase in the direction opposite to `sample/rotation_angle`.
    """

    entry: h5py.Group
    detector: h5py.Group
    data: h5py.Dataset
    image_key: h5py.Dataset
    angle: h5py.Dataset | None
    angle_problem: str
    sense: int = 1

    @property
    def keys(self) -> h5py.Dataset:
        """The codes of the kinds of frames. If the file has two lists, the one that also marks alignment frames."""
        return datasets.dataset(self.detector, "image_key_control") or self.image_key

    def kinds(self) -> NDArray[np.int32]:
        """The kinds of all frames."""
        return kinds_of(np.ravel(datasets.values_of(self.keys)))


def find(file: h5py.File) -> list[Places]:
    """All tomography entries of a file; may be empty. Raises DataError if the frames are in another file that is
    missing.
    """
    places = []
    unresolved: list[str] = []
    for name in file:
        top = datasets.resolve(file, name)
        entries = [top] if isinstance(top, h5py.Group) else []
        entries += [item for item in groups(entries[0]) if "instrument" in item] if entries else []
        for entry in entries:
            for detector in groups(datasets.resolve(entry, "instrument")):
                key = datasets.dataset(detector, "image_key")
                data = datasets.dataset(detector, "data")
                for name in ("data", "image_key"):
                    if broken := datasets.broken_link(detector, name):
                        unresolved.append(broken)
                if key is not None and data is not None and data.ndim == 3:
                    places.append(Places(entry, detector, data, key, *_find_angle(entry, detector, len(data))))
    if unresolved and not places:
        reason = unresolved[0]
        raise DataError(
            f"{file.filename} has no frames: {reason}. The link points to another file: put that other file back into "
            f"the folder of {file.filename}."
        )
    return places


def groups(parent: Any) -> list[h5py.Group]:
    """The groups in a group; [] for any other object."""
    if not isinstance(parent, h5py.Group):
        return []
    items = (datasets.resolve(parent, name) for name in parent)
    return [item for item in items if isinstance(item, h5py.Group)]


def _link(group: h5py.Group, name: str) -> str:
    link = group.get(name, getlink=True)
    where = f"{link.filename}:{link.path}" if isinstance(link, h5py.ExternalLink) else getattr(link, "path", "")
    return f"{group.name}/{name} -> {where}"


def _find_angle(entry: h5py.Group, detector: h5py.Group, n: int) -> tuple[h5py.Dataset | None, str, int]:
    """The angles of n frames, the reason if there are none, and their sense of rotation (1 or -1)."""
    angle = datasets.dataset(entry, "sample/rotation_angle")
    if angle is not None:
        return angle, "", 1
    # Diamond: the NXdata has the name of the detector, and states which scanned axis belongs to the frames.
    data = datasets.resolve(entry, str(detector.name).rsplit("/", 1)[1])
    name = datasets.attribute(data, "axes") if isinstance(data, h5py.Group) else ""  # the name of the first axis
    if isinstance(data, h5py.Group) and name and data.get(name, getlink=True) is not None:
        angle = datasets.dataset(data, name)
        return angle, "" if angle is not None else f"{_link(data, name)} does not exist", 1
    rotations = _rotations_of_sample(entry)
    if len(rotations) == 1:
        return rotations[0][0], "", rotations[0][1]
    if broken := datasets.broken_link(entry, "sample/rotation_angle"):
        return None, broken, 1
    lists = [item for item in datasets.arrays_in(entry.file, (1,)) if item.size == n]
    units = ((item, datasets.factor_of(datasets.attribute(item, "units"), datasets.ANGLE_UNITS)) for item in lists)
    names = [str(item.name) for item, known in units if known is not None]
    candidates = ", ".join(names[:_LISTED])
    which = f"; {candidates} may be the angles: --angles-path {names[0]} uses them" if names else ""
    return None, f"{entry.name} has no sample/rotation_angle{which}", 1


def _rotations_of_sample(entry: h5py.Group) -> list[tuple[h5py.Dataset, int]]:
    """The rotations on which the sample depends and that have several angles, with their sense (1 or -1). If some of
    them change, only those.

    The chain of NXtransformations begins at `sample/depends_on`. The attribute `depends_on` of each step names the next
    step. A step may be a group with a `value`, such as NXpositioner and NXlog. The sense is the sign of the largest
    component of the vector of the rotation.
    """
    here, where, steps, rotations = (
        datasets.resolve(entry, "sample"),
        datasets.text_at(entry, "sample/depends_on"),
        0,
        [],
    )
    while where not in ("", ".") and steps < _LONGEST and (item := datasets.resolve(here, where)) is not None:
        inner = isinstance(item, h5py.Group)
        values = datasets.dataset(item, "value") if inner else datasets.dataset(here, where)
        if values is not None and values.size > 1 and datasets.attribute(item, "transformation_type") == "rotation":
            vector = np.ravel(item.attrs.get("vector", 1))
            against = vector.dtype.kind in "if" and vector[np.abs(vector).argmax()] < 0
            rotations.append((values, -1 if against else 1))
        here, where, steps = item.parent, datasets.attribute(item, "depends_on"), steps + 1
    changing = [each for each in rotations if np.unique(datasets.values_of(each[0])).size > 1]
    return changing or rotations


def choose(file: h5py.File, detectors: list[Places], data: str | None = None) -> Places:
    """The one detector to read: the one whose frames are `data`, or the one named by `default` of file and entry.

    Raises DataError if no detector, or more than one, fits.
    """
    if not detectors:
        raise DataError(
            f"{file.filename} has no NXdetector with frames [frame, row, col] and an image_key. If the frames are in "
            "another place of the file, give --data-path."
        )
    if data is not None:
        return next(places for places in detectors if places.data == datasets.resolve(file, data))
    if len(detectors) == 1:
        return detectors[0]
    default = datasets.attribute(file, "default").strip("/")
    named = [places for places in detectors if str(places.entry.name).strip("/") == default]
    plotted = [places for places in named if _is_default(places)]
    for some in (named, plotted):
        if len(some) == 1:
            return some[0]
    names = ", ".join(
        f"{places.data.name} ({' x '.join(map(str, places.data.shape))})" for places in detectors[:_LISTED]
    )
    first_data = detectors[0].data.name
    raise DataError(
        f"{file.filename} has several detectors with frames, and no attribute `default` names one of these "
        f"detectors: {names}. Choose one detector: --data-path {first_data}."
    )


def _is_default(places: Places) -> bool:
    """True if the NXdata that an entry's `default` names shows these frames."""
    name = datasets.attribute(places.entry, "default")
    data = datasets.resolve(places.entry, name) if name else None
    if not isinstance(data, h5py.Group):
        return False
    signal = datasets.attribute(data, "signal") or "data"
    return bool(datasets.dataset(data, signal) == places.data)


_MAGNIFIED = 0.01  # relative precision of a stated pixel size
_DIVERGED = 0.5  # px: if a ray deviates by more across the whole field of view, the beam is a cone and not parallel
_HC = 12.398419843320026  # keV Å
_BEAMS = ("instrument/beam", "beam", "sample/beam")
_MONOCHROMATOR = "instrument/monochromator"


@dataclass(frozen=True)
class NexusGeometry:
    """The geometry that a file states; None for values that it does not state.

    Attributes:
        pixel_mm: (width, height) of a pixel; for a parallel beam at the sample, for a cone beam on the detector.
        cone: mm from the source to the sample and to the detector; None also for a beam that is practically parallel.
        central_ray: (row, column) at which the central ray meets the detector, in the frames as this program reads
            them; NaN if it is not stated.
        mirrored: whether (rows, columns) of the frames are stored in reverse order.
        turned: rotations of the detector that are not used, as text; "" for none.
        remarks: sentences by name, for `info`.
    """

    pixel_mm: tuple[float | None, float | None]
    cone: tuple[float, float] | None
    central_ray: tuple[float, float]
    mirrored: tuple[bool, bool]
    turned: str
    remarks: dict[str, str]


def read_geometry(places: Places) -> NexusGeometry:
    """The geometry of a file of another program.

    Raises:
        DataError: the distances are impossible.
    """
    detector, entry = places.detector, places.entry
    own = [datasets.scalar(detector, f"{side}_pixel_size", datasets.LENGTH_UNITS) for side in "xy"]
    at_sample = [datasets.scalar(entry, f"sample/{side}_pixel_size", datasets.LENGTH_UNITS) for side in "xy"]
    pixels = [theirs or ours for theirs, ours in zip(at_sample, own, strict=True)]
    cone, remarks = _cone_of(places, own[0], at_sample[0])
    if cone is not None:  # size on the detector
        sod, sdd = cone
        pixels = [theirs * sdd / sod if theirs else ours for theirs, ours in zip(at_sample, own, strict=True)]
    mirrored, turned = _mirrored(detector)
    if mirrored_directions := [
        name for name, is_so in zip(("upside down", "left to right"), mirrored, strict=True) if is_so
    ]:
        remarks["flipped"] = f"{' and '.join(mirrored_directions)}: frames are mirrored back when they are read"
    pixel_sizes = [own[0] or pixels[0], own[1] or pixels[1] or own[0]]
    row, col = (_central(places, i, pixel_sizes[i], mirrored[1 - i]) for i in (1, 0))
    return NexusGeometry((pixels[0], pixels[1]), cone, (row, col), mirrored, turned, remarks)


def _central(places: Places, along: int, pitch: float | None, reverse: bool) -> float:
    """Where the central ray meets the detector along x (0) or y (1), in pixels. The file may state it in mm or in
    pixels; NaN if it does not.
    """
    pixels = {"": 1.0, "px": 1.0, "pixel": 1.0}
    pixels |= {name: mm / pitch for name, mm in datasets.LENGTH_UNITS.items()} if pitch else {}
    pixel = datasets.scalar(places.detector, f"beam_center_{'xy'[along]}", pixels)
    return math.nan if pixel is None else places.data.shape[2 - along] - 1 - pixel if reverse else pixel


def _cone_of(
    places: Places, own: float | None, at_sample: float | None
) -> tuple[tuple[float, float] | None, dict[str, str]]:
    """The value `cone` of `NexusGeometry`, and a remark if the beam is practically parallel. Widths of pixels are in
    mm.
    """
    upstream = _source_distance(places.entry)
    detector_distance = datasets.scalar(places.detector, "distance", datasets.LENGTH_UNITS)
    if upstream is None or detector_distance is None:
        return None, {}
    sod, sdd = abs(upstream), abs(upstream) + detector_distance
    if not (sod > 0 and detector_distance >= 0):
        raise DataError(
            f"{places.entry.file.filename}: the source is {upstream:g} mm from the sample and the detector "
            f"{detector_distance:g} mm behind it; expected a source distance other than 0 and a detector distance of 0 "
            "or more. Correct the distances in a copy of the file."
        )
    width, cols = at_sample or (None if own is None else own * sod / sdd), places.data.shape[2]
    diverged = None if width is None else width * cols / 2 / sod * cols / 2
    if sdd / sod > 1 + _MAGNIFIED or (diverged is not None and diverged > _DIVERGED):
        return (sod, sdd), {}
    by = (
        ""
        if diverged is None
        else f", and rays deviate from parallel ones by {diverged:.2g} px within the field of view"
    )
    magnified = sdd / sod
    return None, {"source_distance": f"{sod:g} mm, treated as a parallel beam (magnification {magnified:.4f}{by})"}


def differing(height: float | None, width: float | None) -> float | None:
    """The height of a pixel if it differs from its width by more than a thousandth; None for a square pixel."""
    return height if height is not None and (width is None or abs(height - width) > 1e-3 * abs(width)) else None


def require_order(places: Places) -> None:
    """Raise DataError if the attribute `axes` of the detector's NXdata names an order other than frame, row, column."""
    for name in ("data", str(places.detector.name).rsplit("/", 1)[1]):
        nxdata = datasets.resolve(places.entry, name)
        if not isinstance(nxdata, h5py.Group) or "axes" not in nxdata.attrs:
            continue
        axes = [
            datasets.text(axis) for part in np.ravel(nxdata.attrs["axes"]) for axis in datasets.text(part).split(":")
        ]
        if order_of_axes(axes) not in (None, (0, 1, 2)):
            stated_axes = ", ".join(axes)
            raise DataError(
                f"{nxdata.name} in {places.entry.file.filename} states the axes {stated_axes}; expected frames "
                "[frame, row, col]: the rotation angle, then y, then x. Reorder the frames in a copy of the file, "
                "or correct the attribute `axes`."
            )


def read_energy(entry: h5py.Group) -> float | None:
    """Photon energy in keV, from an energy or a wavelength of the beam or the monochromator; None for a spectrum."""
    values = _energies(entry, 1)
    return None if values is None or not np.isfinite(values[0]) else float(values[0])


def read_energies(entry: h5py.Group, n: int) -> NDArray[np.float64] | None:
    """float64 [frame] keV; None if the file has no such list."""
    values = _energies(entry, n) if n > 1 else None
    return None if values is None or not np.isfinite(values).any() else values


def _energies(entry: h5py.Group, n: int) -> NDArray[np.float64] | None:
    """`n` energies in keV, from the first place that has them in a known unit."""
    for energy, wavelength, groups_ in (
        ("incident_energy", "incident_wavelength", _BEAMS),
        ("energy", "wavelength", (_MONOCHROMATOR,)),
    ):
        for name, units, angstrom in (
            (energy, datasets.ENERGY_UNITS, False),
            (wavelength, datasets.WAVELENGTH_UNITS, True),
        ):
            for where in groups_:
                item = datasets.dataset(entry, f"{where}/{name}")
                values = None if item is None or item.size != n else datasets.in_units(item, units)
                if values is not None and (known := np.where(values > 0, values, np.nan))[np.isfinite(known)].size:
                    return _HC / known if angstrom else known
    return None


def _source_distance(entry: h5py.Group) -> float | None:
    """The distance of the source in mm. NXsource defines it as negative in front of the sample, but some programs omit
    the sign.
    """
    instrument = datasets.resolve(entry, "instrument")
    for group in groups(instrument):
        if datasets.attribute(group, "NX_class") == "NXsource" or str(group.name).endswith("/source"):
            distance = datasets.scalar(group, "distance", datasets.LENGTH_UNITS)
            if distance is not None:
                return distance
    return None


def _mirrored(detector: h5py.Group) -> tuple[tuple[bool, bool], str]:
    """Whether (rows, columns) are stored in reverse order, from flags or from rotations of the detector by 180°. Other
    rotations are returned as text.

    A rotation by 180° about the vertical axis mirrors left and right. About the horizontal axis across the beam it
    mirrors top and bottom, and about the beam it mirrors both. The vertical axis is the one along which gravity points:
    z, with the beam along x (axes of ESRF), or y, with the beam along z (axes of McStas).
    """
    rows, cols = (_flag(detector, name) for name in ("y_flipped", "x_flipped"))
    if rows or cols:
        return (rows, cols), ""
    turns = datasets.resolve(detector, "transformations")
    if not isinstance(turns, h5py.Group):
        return (False, False), ""
    gravity = datasets.dataset(turns, "gravity")
    vertical = None if gravity is None else _direction(gravity)
    others = []
    for name, angle, axis in _rotations(turns):
        if vertical not in (1, 2) or axis is None or abs(angle - 180) > 1e-6:
            others.append(f"{name} {angle:g}°")
            continue
        rows ^= axis != vertical
        cols ^= axis in (vertical, 0 if vertical == 2 else 2)  # about the beam
    return (rows, cols), ", ".join(others)


def _rotations(turns: h5py.Group) -> Iterator[tuple[str, float, int | None]]:
    """Name, angle in degrees, and axis of each rotation of a detector. The axis is x, y or z; None: any other axis."""
    for name in turns:
        item = datasets.dataset(turns, name)
        if item is None or datasets.attribute(item, "transformation_type") != "rotation" or item.size != 1:
            continue
        angle = float(np.degrees(datasets.radians(item, default="degrees"))[0]) % 360
        if np.isfinite(angle) and min(angle, 360 - angle) > 1e-6:
            yield name, angle, _direction(item)


def _flag(detector: h5py.Group, name: str) -> bool:
    item = datasets.dataset(detector, name)
    if item is None or item.size != 1:
        return False
    return datasets.text_of(item).strip().lower() in ("1", "1.0", "true", "yes")


def _direction(item: h5py.Dataset) -> int | None:
    """The axis (x, y or z) to which the attribute `vector` is parallel; None if it is not parallel to any of them."""
    vector = np.ravel(np.asarray(item.attrs.get("vector", ())))
    if vector.dtype.kind not in "iuf":
        return None
    along = np.flatnonzero(vector)
    return int(along[0]) if vector.size == 3 and along.size == 1 else None
