"""Where NeXus files keep a scan: the detector with frames and image keys, and the angles that belong to it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import h5py

from beamline.core.errors import DataError
from beamline.storage import hdf5

_LISTED = 6  # detectors that an error names


@dataclass(frozen=True, eq=False)
class Places:
    """Where a file keeps what we need; None where it does not."""

    entry: h5py.Group
    detector: h5py.Group
    data: h5py.Dataset
    image_key: h5py.Dataset
    angle: h5py.Dataset | None
    angle_problem: str


def find(file: h5py.File) -> list[Places]:
    """Every tomography entry of a file; [] where it has none. DataError where the frames' own file is missing."""
    found = []
    unresolved: list[str] = []
    for name in file:
        top = hdf5.resolve(file, name)
        entries = [top] if isinstance(top, h5py.Group) else []
        entries += [item for item in groups(entries[0]) if "instrument" in item] if entries else []
        for entry in entries:
            for detector in groups(hdf5.resolve(entry, "instrument")):
                key = hdf5.dataset(detector, "image_key")
                data = hdf5.dataset(detector, "data")
                for name in ("data", "image_key"):
                    if broken := hdf5.broken_link(detector, name):
                        unresolved.append(broken)
                if key is not None and data is not None and data.ndim == 3:
                    found.append(Places(entry, detector, data, key, *_find_angle(entry, detector)))
    if unresolved and not found:
        raise DataError(f"{file.filename} has no frames: {unresolved[0]}. Put the linked file back beside this one.")
    return found


def groups(parent: Any) -> list[h5py.Group]:
    """The groups in a group; [] for anything else."""
    if not isinstance(parent, h5py.Group):
        return []
    items = (hdf5.resolve(parent, name) for name in parent)
    return [item for item in items if isinstance(item, h5py.Group)]


def _link(group: h5py.Group, name: str) -> str:
    link = group.get(name, getlink=True)
    where = f"{link.filename}:{link.path}" if isinstance(link, h5py.ExternalLink) else getattr(link, "path", "")
    return f"{group.name}/{name} -> {where}"


def _find_angle(entry: h5py.Group, detector: h5py.Group) -> tuple[h5py.Dataset | None, str]:
    angle = hdf5.dataset(entry, "sample/rotation_angle")
    if angle is not None:
        return angle, ""
    # Diamond: the NXdata named as the detector says which scanned axis goes with the frames.
    data = hdf5.resolve(entry, str(detector.name).rsplit("/", 1)[1])
    name = hdf5.attribute(data, "axes") if isinstance(data, h5py.Group) else ""  # the first of the axes
    if isinstance(data, h5py.Group) and name and data.get(name, getlink=True) is not None:
        angle = hdf5.dataset(data, name)
        return angle, "" if angle is not None else f"{_link(data, name)} is not there"
    return None, hdf5.broken_link(entry, "sample/rotation_angle") or f"{entry.name} has no sample/rotation_angle"


def choose(file: h5py.File, found: list[Places], data: str | None = None) -> Places:
    """The one detector to read: whose frames are `data`, or which the attributes `default` of file and entry name.

    DataError where there is none, or several could be meant.
    """
    if not found:
        raise DataError(f"{file.filename} has no NXdetector with frames [frame, row, col] and an image_key.")
    if data is not None:
        return next(places for places in found if places.data == hdf5.resolve(file, data))
    if len(found) == 1:
        return found[0]
    default = hdf5.attribute(file, "default").strip("/")
    named = [places for places in found if str(places.entry.name).strip("/") == default]
    plotted = [places for places in named if _is_default(places)]
    for some in (named, plotted):
        if len(some) == 1:
            return some[0]
    names = ", ".join(f"{places.data.name} ({' x '.join(map(str, places.data.shape))})" for places in found[:_LISTED])
    raise DataError(
        f"{file.filename} has several detectors with frames, and no attribute `default` names one of them: {names}. "
        f"Say which: --data-path {found[0].data.name}."
    )


def _is_default(places: Places) -> bool:
    """Whether the NXdata that an entry's `default` names shows these frames."""
    name = hdf5.attribute(places.entry, "default")
    data = hdf5.resolve(places.entry, name) if name else None
    if not isinstance(data, h5py.Group):
        return False
    signal = hdf5.attribute(data, "signal") or "data"
    return bool(hdf5.dataset(data, signal) == places.data)
