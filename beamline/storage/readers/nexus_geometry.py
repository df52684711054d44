"""Geometry and energy that an NXtomo and the classes that it names state: pixels, a cone beam, mirrored frames."""

from __future__ import annotations

from dataclasses import dataclass

import h5py
import numpy as np

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.readers.nexus_places import Places, groups
from beamline.storage.readers.turned import dimensions

_MAGNIFIED = 0.01  # a pixel size is not known better
_DIVERGED = 0.5  # px by which a ray leaves its parallel across the whole field, before a beam is a cone
_HC = 12.398419843320026  # keV Å
_BEAMS = ("instrument/beam", "beam", "sample/beam")
_MONOCHROMATOR = "instrument/monochromator"


@dataclass(frozen=True)
class NexusGeometry:
    """What a file states; None for what it does not.

    Attributes:
        pixel_mm: (width, height) of a pixel: at the sample, of a cone on the detector.
        cone: mm from the source to the sample and to the detector; None also for a beam that is as good as parallel.
        mirrored: (rows, columns) of the frames are in reverse order.
        turned: turns of the detector that are not used, as text; "" for none.
        remarks: sentences by name, for `info`.
    """

    pixel_mm: tuple[float | None, float | None]
    cone: tuple[float, float] | None
    mirrored: tuple[bool, bool]
    turned: str
    remarks: dict[str, str]


def read_geometry(places: Places) -> NexusGeometry:
    """Of a foreign file.

    Raises:
        DataError: distances that cannot be.
    """
    detector, entry, remarks = places.detector, places.entry, dict[str, str]()
    own = [hdf5.scalar(detector, f"{side}_pixel_size", hdf5.LENGTH_UNITS) for side in "xy"]
    at_sample = [hdf5.scalar(entry, f"sample/{side}_pixel_size", hdf5.LENGTH_UNITS) for side in "xy"]
    pixels = [theirs or ours for theirs, ours in zip(at_sample, own, strict=True)]
    cone = None
    upstream, beyond = _source_distance(entry), hdf5.scalar(detector, "distance", hdf5.LENGTH_UNITS)
    if upstream is not None and beyond is not None:
        sod, sdd = abs(upstream), abs(upstream) + beyond
        if not (sod > 0 and beyond >= 0):
            raise DataError(
                f"{entry.file.filename}: the source is {upstream:g} mm from the sample and the detector {beyond:g} mm "
                "behind it; expected distances of the source that are not 0, and of the detector from 0 on. Correct "
                "them in a copy of the file."
            )
        width = at_sample[0] or (None if own[0] is None else own[0] * sod / sdd)
        field = None if width is None else width * places.data.shape[2] / 2
        diverged = None if field is None else field / sod * places.data.shape[2] / 2
        if sdd / sod > 1 + _MAGNIFIED or (diverged is not None and diverged > _DIVERGED):
            cone = sod, sdd
            pixels = [
                theirs * sdd / sod if theirs else ours for theirs, ours in zip(at_sample, own, strict=True)
            ]  # on the detector
        else:
            by = "" if diverged is None else f", and rays leave their parallels by {diverged:.2g} px in the field"
            remarks["source_distance"] = f"{sod:g} mm: a parallel beam (magnification {sdd / sod:.4f}{by})"
    mirrored, turned = _mirrored(detector)
    if any(mirrored):
        how = " and ".join(
            name for name, is_so in zip(("upside down", "left to right"), mirrored, strict=True) if is_so
        )
        remarks["flipped"] = f"{how}: frames are mirrored back as they are read"
    return NexusGeometry((pixels[0], pixels[1]), cone, mirrored, turned, remarks)


def differing(height: float | None, width: float | None) -> float | None:
    """The height of a pixel where it is not its width, to a part in a thousand; None for a square one."""
    return height if height is not None and (width is None or abs(height - width) > 1e-3 * abs(width)) else None


def require_order(places: Places) -> None:
    """DataError where the attribute `axes` of the detector's NXdata names an order other than frame, row, column."""
    for name in ("data", str(places.detector.name).rsplit("/", 1)[1]):
        nxdata = hdf5.resolve(places.entry, name)
        if not isinstance(nxdata, h5py.Group) or "axes" not in nxdata.attrs:
            continue
        axes = [hdf5.text(axis) for part in np.ravel(nxdata.attrs["axes"]) for axis in hdf5.text(part).split(":")]
        if dimensions(axes) not in (None, (0, 1, 2)):
            raise DataError(
                f"{nxdata.name} in {places.entry.file.filename} says that its axes are {', '.join(axes)}; expected "
                "frames [frame, row, col]: the rotation angle, then y, then x. Turn the frames in a copy of the file, "
                "or correct the attribute `axes`."
            )


def read_energy(entry: h5py.Group) -> float | None:
    """Of the photons in keV, by an energy or a wavelength of the beam or the monochromator; None for a spectrum."""
    for energy, wavelength, groups_ in (
        ("incident_energy", "incident_wavelength", _BEAMS),
        ("energy", "wavelength", (_MONOCHROMATOR,)),
    ):
        for where in groups_:
            kev = _one(entry, f"{where}/{energy}", hdf5.ENERGY_UNITS)
            if kev is not None:
                return kev
        for where in groups_:
            angstrom = _one(entry, f"{where}/{wavelength}", hdf5.WAVELENGTH_UNITS)
            if angstrom is not None and angstrom > 0:
                return _HC / angstrom
    return None


def _one(entry: h5py.Group, path: str, units: dict[str, float]) -> float | None:
    item = hdf5.dataset(entry, path)
    return None if item is None or item.size != 1 else hdf5.scalar(entry, path, units)


def _source_distance(entry: h5py.Group) -> float | None:
    """mm, negative before the sample, as NXsource has it; some write it without the sign."""
    instrument = hdf5.resolve(entry, "instrument")
    for group in groups(instrument):
        if hdf5.attribute(group, "NX_class") == "NXsource" or str(group.name).endswith("/source"):
            distance = hdf5.scalar(group, "distance", hdf5.LENGTH_UNITS)
            if distance is not None:
                return distance
    return None


def _mirrored(detector: h5py.Group) -> tuple[tuple[bool, bool], str]:
    """(rows, columns) in reverse order, by flags or by half turns of the detector; other turns as text.

    A half turn about the vertical mirrors left to right, one about the horizontal across the beam upside down, and one
    about the beam both. The vertical is where gravity points, z or y; the beam is then x or z (ESRF's or McStas' axes).
    """
    rows, cols = (_flag(detector, name) for name in ("y_flipped", "x_flipped"))
    if rows or cols:
        return (rows, cols), ""
    turns = hdf5.resolve(detector, "transformations")
    if not isinstance(turns, h5py.Group):
        return (False, False), ""
    gravity = hdf5.dataset(turns, "gravity")
    vertical = None if gravity is None else _direction(gravity)
    others = []
    for name in turns:
        item = hdf5.dataset(turns, name)
        if item is None or hdf5.attribute(item, "transformation_type") != "rotation" or item.size != 1:
            continue
        angle = float(np.degrees(hdf5.radians(item, default="degrees"))[0]) % 360
        axis = _direction(item)
        if not np.isfinite(angle) or min(angle, 360 - angle) < 1e-6:
            continue
        if vertical not in (1, 2) or axis is None or abs(angle - 180) > 1e-6:
            others.append(f"{name} {angle:g}°")
        elif axis == vertical:
            cols = not cols
        elif axis == (0 if vertical == 2 else 2):  # the beam
            rows, cols = not rows, not cols
        else:
            rows = not rows
    return (rows, cols), ", ".join(others)


def _flag(detector: h5py.Group, name: str) -> bool:
    item = hdf5.dataset(detector, name)
    if item is None or item.size != 1:
        return False
    return hdf5.text_of(item).strip().lower() in ("1", "1.0", "true", "yes")


def _direction(item: h5py.Dataset) -> int | None:
    """Which of x, y, z the attribute `vector` runs along; None for none of them."""
    vector = np.ravel(np.asarray(item.attrs.get("vector", ())))
    if vector.dtype.kind not in "iuf":
        return None
    along = np.flatnonzero(vector)
    return int(along[0]) if vector.size == 3 and along.size == 1 else None
