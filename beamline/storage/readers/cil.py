"""The geometry that CIL's NEXUSDataWriter states beside projections: pixels, distances, axis and angles; lengths in mm.

CIL turns the object by its angles counter-clockwise about the axis, which is the beam turned by their negative (its
`convert_geometry_to_astra_vec_3D`). Here the view turns by θ in the frame of the detector: columns, beam, rows.
"""

from __future__ import annotations

from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.storage import datasets
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.nexus import differing
from recon.base.arrays import F64

DATA = "entry1/tomo_entry/data/data"
CONFIG = "config"


def is_scan(file: h5py.File) -> bool:
    """Whether CIL wrote projections into a file."""
    data = datasets.resolve(file, DATA)
    return isinstance(data, h5py.Dataset) and datasets.attribute(data, "data_type") == "AcquisitionData"


def take_geometry(source: ScanSource, views: Any) -> None:
    """Take what stands beside `views`, the dataset of the projections, where CIL wrote it."""
    config = datasets.resolve(views.parent.parent, CONFIG) if isinstance(views, h5py.Dataset) else None
    if not isinstance(config, h5py.Group) or "pixel_size_h" not in views.attrs:
        return
    source.pixel_size_mm, height = (float(views.attrs.get(f"pixel_size_{side}", np.nan)) for side in "hv")
    source.row_pitch_mm = differing(height if np.isfinite(height) else None, source.pixel_size_mm)
    pitch = np.array([source.row_pitch_mm or source.pixel_size_mm, source.pixel_size_mm])
    across, up, beam = _frame(config)
    end, axis = (_vector(config, f"{name}/position", (0, 0, 0)) for name in ("detector", "rotation_axis"))
    middle, plane = (np.array(source.shape) - 1) / 2, np.array([up, across])
    if datasets.dataset(config, "source/position") is not None:
        start, normal = _vector(config, "source/position", (0, 0, 0)), np.cross(across, up)
        normal *= np.sign(normal @ beam)
        source.cone = float(normal @ (axis - start)), float(normal @ (end - start))
        foot = start + source.cone[1] * normal  # of the central ray
        source.central_ray = tuple((middle + plane @ (foot - end) / pitch).tolist())
        axis = start + (axis - start) * source.cone[1] / source.cone[0]
    source.axis_col = float((middle + plane @ (axis - end) / pitch)[1])
    angles = datasets.dataset(config, "angles")
    if angles is not None and angles.size == source.image_key.size:
        source.angles = turned(angles, datasets.radians(angles), "")


def turned(item: Any, angles: F64, unit: str | None) -> F64:
    """Radians of views in the frame of their detector, from those of CIL's object; others as they are.

    Args:
        angles: the values of `item` in radians.
        unit: of them, where the caller says another one than the file.
    """
    config = item.parent if isinstance(item, h5py.Dataset) else None
    if config is None or datasets.dataset(config, "detector/direction_x") is None:
        return angles
    across, up, beam = _frame(config)
    sense = -np.sign(np.linalg.det([across, beam, up]) * (_vector(config, "rotation_axis/direction", (0, 0, 1)) @ up))
    factor = datasets.factor_of(unit or datasets.attribute(item, "angle_unit"), datasets.ANGLE_UNITS) or 0.0
    return np.asarray(sense * (angles + float(item.attrs.get("initial_angle", 0)) * factor)) + 0.0  # no -0


def _frame(config: h5py.Group) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Along which columns, rows and the beam run."""
    origin = datasets.attribute(datasets.resolve(config.parent, "data/data") or config, "panel_origin")
    across = _vector(config, "detector/direction_x", (1, 0, 0)) * (-1 if "right" in origin else 1)
    up = _vector(config, "detector/direction_y", (0, 0, 1)) * (-1 if "top" in origin else 1)
    if datasets.dataset(config, "source/position") is None:
        return across, up, _vector(config, "ray/direction", (0, 1, 0))
    end, start = (_vector(config, f"{name}/position", (0, 0, 0)) for name in ("detector", "source"))
    return across, up, end - start


def _vector(config: h5py.Group, where: str, default: tuple[float, ...]) -> NDArray[np.float64]:
    """(x, y, z); of two dimensions, z is 0."""
    item = datasets.dataset(config, where)
    values = np.ravel(default if item is None else datasets.values_of(item)).astype(np.float64)
    return np.pad(values[:3], (0, 3 - min(values.size, 3)))
