"""Shows volumes, labels and Gaussians in napari, each at its position and in its unit."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from importlib import import_module
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from beamline.core.errors import ConfigError, DataError
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord
from beamline.storage.volume_file import axes_of
from beamline.storage.volumes.files import opened_volume


def show(volumes: Sequence[Path], labels: Path | None) -> None:
    """Open a window, and return when it is closed.

    Raises: ConfigError: napari is not installed. DataError: a file does not contain a volume, or the labels do not
    belong to the first volume.
    """
    try:
        napari: Any = import_module("napari")
    except ImportError as error:
        raise ConfigError(
            f'--napari needs napari, which cannot be loaded here ({error}): pip install "napari[all]".'
        ) from error
    with ExitStack() as opened:
        records = [opened.enter_context(opened_volume(path)) for path in volumes]
        label_layer = None if labels is None else _labels(labels, records[0])
        viewer = napari.Viewer(title=", ".join(path.name for path in volumes))
        for path, record in zip(volumes, records, strict=True):
            viewer.add_image(_values(record), name=path.name, **_place(record))
        if label_layer is not None:
            viewer.add_labels(label_layer[0], name=str(labels), **label_layer[1])
        if model := records[0].model:
            place = _place(records[0])  # in voxels, because napari assigns points to slices by whole numbers
            centres = (np.asarray(model["centres"])[:, ::-1] - place["translate"]) / place["scale"]
            size = 2 * np.asarray(model["widths"]).mean(axis=1) / records[0].volume.grid.voxel_size
            viewer.add_points(
                centres, size=size, name="Gaussians", features={"density": np.asarray(model["densities"])},
                # hidden at first, because they would cover the volume
                face_color="density", border_width=0, opacity=0.7, visible=False, **place,
            )  # fmt: skip
        napari.run()


def _values(record: ReconRecord) -> Any:
    """Data that napari can slice along any axis. Datasets and memory-mapped files are used as they are; other files are
    read."""
    data = record.volume.data
    return data if isinstance(data, h5py.Dataset | np.ndarray) else data[:]


def _place(record: ReconRecord) -> dict[str, Any]:
    first = [float(centres[0]) for centres in record.volume.grid.coordinates()]
    unit = "pixel" if record.length_unit == "px" else record.length_unit
    return {"scale": tuple(map(float, record.volume.grid.spacing)), "translate": tuple(first), "units": (unit,) * 3}


def _labels(path: Path, volume: ReconRecord) -> tuple[Any, dict[str, Any]]:
    """Labels, and their position. It is that of the volume, or that of a part of the volume, if the file of the labels
    states it (`structure`)."""
    with opened_volume(path) as record:
        values, place = np.asarray(record.volume.data[:]), _place(volume)
    if values.shape != volume.volume.grid.shape and h5py.is_hdf5(path):
        with hdf5.open_hdf5(path) as file:
            scale, translate = axes_of(file, "entry/data/labels", volume.length_unit)
        place |= {"scale": scale, "translate": translate}
    elif values.shape != volume.volume.grid.shape:
        place["scale"] = None
    if place["scale"] is None or not np.array_equal(values, values.astype(np.int32)):
        raise DataError(
            f"{path} has {values.dtype} values of shape {values.shape}; expected whole numbers of the shape of the "
            f"volume, {volume.volume.grid.shape}, or an HDF5 file that `beamline structure` made from this volume."
        )
    return values.astype(np.int32), place
