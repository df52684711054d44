"""Reads a volume [z, y, x] from a TIFF, a folder of slices, NumPy, NIfTI, HDF5 or Zarr."""

from __future__ import annotations

import math
import re
import zipfile
from pathlib import Path
from types import MappingProxyType
from typing import Any

import h5py
import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image
from tifffile import natural_sorted

from beamline.core.errors import DataError
from beamline.core.files import RECON, no_file, refuse_substitute, require_regular
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import is_zarr, numpy_arrays, require_room
from beamline.storage.foreign_zarr import open_zarr
from beamline.storage.readers.side_files import reconstructed_pixel_mm
from beamline.storage.readers.tiff import require_possible

LENGTHS = MappingProxyType({0: 1.0, 1: 1e3, 2: 1.0, 3: 1e-3})
"""Length in mm of the units in NIfTI's xyzt_units: metre, millimetre and micrometre. An unstated unit counts as mm."""
_RESOLUTIONS = "YResolution", "XResolution"  # pixels per unit, as fractions
SUFFIXES = (".tif", ".tiff", ".npy", ".npz", ".nii", ".nii.gz", ".h5", ".hdf5", ".nxs")


def read_volume(
    path: Path, dataset: str | None = None
) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    """Read a volume, and the voxel spacing in mm along its axes, if the file states it.

    The spacing is stated by NIfTI, OME-Zarr, TIFFs of ImageJ and OME, and by `voxel_mm` (`slice_mm`) in an .npz. There,
    1 means a voxel of a pixel whose size is not known.

    Args:
        dataset: path in an HDF5 file or a Zarr, or name in an .npz; None: the only array with three axes.

    Raises:
        DataError: the file has none of these formats, it is unreadable, it is too large for the memory, or it does not
            contain the array.
    """
    name = path.name.lower()
    if is_zarr(path):
        scale, spacing = open_zarr(path, dataset)
        require_room(path, math.prod(scale.shape) * scale.dtype.itemsize)
        return scale[:], spacing
    if path.is_dir():
        return _from_folder(path)
    if not path.is_file():
        raise DataError(no_file(path))
    if dataset is not None and name.endswith((".tif", ".tiff", ".npy", ".nii", ".nii.gz")):
        raise DataError(
            f"{path} contains one volume, so a dataset ({dataset!r}) cannot be chosen; datasets exist in HDF5 "
            "and .npz files."
        )
    is_hdf5, is_numpy = h5py.is_hdf5(path), _is_numpy(path)
    if not (is_hdf5 or is_numpy or name.endswith(SUFFIXES)):
        raise DataError(f"{path} is not a known volume file; the known suffixes are {', '.join(SUFFIXES)}.")
    if name.endswith((".npz", ".npy")) and not is_numpy:
        raise DataError(f"{path} cannot be read: its name ends in .npz or .npy, but its content is neither.")
    try:
        if name.endswith((".nii", ".nii.gz")):
            return _from_nifti(path)
        if is_hdf5 or name.endswith((".h5", ".hdf5", ".nxs")):
            with hdf5.open_hdf5(path) as file:
                return _from_hdf5(path, file, dataset)
        if name.endswith((".tif", ".tiff")):
            return _from_tiff(path)
        return _from_numpy(path, dataset)
    except DataError:
        raise
    except Exception as error:  # readers of foreign files raise various errors if a file is damaged
        raise DataError(f"{path} cannot be read ({type(error).__name__}: {error}).") from error


def axes_of(
    file: h5py.File, dataset: str | None, unit: str = "mm"
) -> tuple[tuple[float, float, float] | None, tuple[float, ...] | None]:
    """Voxel spacing and first coordinates (z, y, x), from the arrays z, y and x next to a dataset.

    None: the arrays are missing, or are not in `unit`.
    """
    node = None if dataset is None else file.get(dataset)
    axes = [] if node is None else [node.parent.get(name) for name in "zyx"]
    if not axes or any(not isinstance(axis, h5py.Dataset) or axis.size < 2 for axis in axes):
        return None, None
    if any(axis.attrs.get("units") != unit for axis in axes):
        return None, None
    ends = [(float(axis[0]), float(axis[-1]), axis.size) for axis in axes]
    dz, dy, dx = ((last - low) / (n - 1) for low, last, n in ends)
    return (dz, dy, dx), tuple(low for low, _, _ in ends)


def _is_numpy(path: Path) -> bool:
    """True if the first bytes are those of a NumPy file, whatever its name is."""
    with path.open("rb") as file:
        return file.read(6).startswith((b"PK", b"\x93NUMPY"))


def _from_tiff(path: Path) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    require_regular(path)
    refuse_substitute(path)
    with tifffile.TiffFile(path) as tif:
        require_possible(tif)
        series = tif.series[0]
        require_room(path, math.prod(series.shape) * np.dtype(series.dtype).itemsize)
        return tif.asarray(), _tiff_spacing(tif)


def _tiff_spacing(tif: tifffile.TiffFile) -> tuple[float, float, float] | None:
    """Edges of a voxel (z, y, x) in mm. None unless Fiji (unit, spacing and resolutions) or OME states all three."""
    facts, tags = tif.imagej_metadata or {}, tif.pages.first.tags
    edges: list[Any] = [facts.get("spacing"), *(tags[name].value if name in tags else None for name in _RESOLUTIONS)]
    units = [str(facts.get("unit")).replace("\\u00B5", "µ")] * 3
    if tif.is_ome:
        pixels = re.search(r"<(?:\w+:)?Pixels\b[^>]*>", tif.ome_metadata or "")
        stated = dict(re.findall(r'PhysicalSize(\w+)="([^"]*)"', pixels[0] if pixels else ""))
        edges, units = [stated.get(each) for each in "ZYX"], [stated.get(f"{each}Unit", "µm") for each in "ZYX"]
    try:
        mm = [
            (edge[1] / edge[0] if isinstance(edge, tuple) else float(edge))
            * (datasets.factor_of(unit, datasets.LENGTH_UNITS) or math.nan)
            for edge, unit in zip(edges, units, strict=True)
        ]
    except (TypeError, ValueError, ArithmeticError):
        return None
    # A grid cannot represent pixels that are not square: the user must state an edge.
    z, y, x = mm
    return (z, y, x) if all(0 < each < math.inf for each in mm) and math.isclose(y, x, rel_tol=1e-3) else None


_PICTURES = (".png", ".bmp", ".jpg", ".jpeg")


def _from_folder(path: Path) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    """The slices in a folder, in the order of the numbers in their names. Also the edges of a voxel in mm, if the log
    of NRecon next to them states the size.

    Slices are the TIFFs whose names differ only in numbers; if there are none, the grey pictures. A single file with
    another name, such as a preview, is not a slice.
    """
    names = natural_sorted(item.name for item in path.iterdir() if not item.name.startswith("."))
    by_kind = ([name for name in names if name.lower().endswith(kind)] for kind in ((".tif", ".tiff"), _PICTURES))
    series: dict[str, list[str]] = {}
    for name in next(filter(None, by_kind), []):
        series.setdefault(re.sub(r"-?\d+", "#", name), []).append(name)
    files = max(series.values(), key=len, default=[])
    # if there is a z-1 as well as a z1, the mark is a sign and not a hyphen
    if len({re.sub(r"\d+", "#", name) for name in files}) > 1:
        files.sort(key=lambda name: [int(number) for number in re.findall(r"-?\d+", name)])
    files = files if len(files) > 1 else [name for names_of_series in series.values() for name in names_of_series]
    if not files:
        inside = [path / name for name in (RECON, "volume.h5") if (path / name).is_file()]
        raise DataError(
            f"{path} is a folder without slices as TIFF or grey pictures"
            + (
                f"; the folder contains the volume {inside[0]}."
                if inside
                else f"; a volume must be such a folder, a Zarr, or {', '.join(SUFFIXES)}."
            )
        )
    if others := [
        f"{len(names_of_series)} of {name}"
        for name, names_of_series in series.items()
        if len(names_of_series) > 1 and names_of_series is not files
    ]:
        example = files[0]
        raise DataError(
            f"Put each volume into a folder of its own. {path} contains several series of images: {len(files)} images "
            f"such as {example}, {', '.join(others)}."
        )
    slices: NDArray[np.generic] | None = None
    for z, name in enumerate(files):
        try:
            values = _of_picture(path / name) if name.lower().endswith(_PICTURES) else _from_tiff(path / name)[0]
        except Exception as error:  # as for other files of other programs
            raise DataError(f"{path / name} cannot be read ({type(error).__name__}: {error}).") from error
        if slices is None:
            require_room(path, values.nbytes * len(files))
            slices = np.empty((len(files), *values.shape), values.dtype)
        if values.ndim != 2 or (values.shape, values.dtype) != (slices.shape[1:], slices.dtype):
            raise DataError(
                f"{path / name} has the type {values.dtype} and the shape {values.shape}; expected slices [y, x] of "
                f"the type {slices.dtype} and the shape {slices.shape[1:]}."
            )
        slices[z] = values
    assert slices is not None
    edges = {edge for log in path.glob("*.log") if (edge := reconstructed_pixel_mm(log)) is not None}
    return slices, (edges.pop(),) * 3 if len(edges) == 1 else None


def _of_picture(path: Path) -> NDArray[np.generic]:
    """A picture [y, x]. It may have colours if all of them are greys."""
    with Image.open(path) as picture:
        if picture.mode.startswith(("L", "I", "F")) and picture.mode != "LA":
            return np.asarray(picture)
        colours = np.asarray(picture.convert("RGB"))
    if np.ptp(colours, axis=2).any():
        raise ValueError("it has colours; expected grey values")
    return np.ascontiguousarray(colours[..., 0])


def _from_nifti(path: Path) -> tuple[NDArray[np.generic], tuple[float, float, float]]:
    """Reads NIfTI (Cox et al. 2004): the values, scaled as the header states, and the voxel spacing in mm along z, y,
    x.

    Scaled values are float32; other values have the type in the file. The orientation of the patient is not applied.
    """
    try:
        import nibabel
    except ImportError as error:
        raise DataError(
            f"{path} is a NIfTI volume. Reading it needs the package nibabel, which cannot be loaded "
            f"({error}): pip install splatline[nifti]."
        ) from error
    image: Any = nibabel.load(path)
    shape, unit = image.shape, LENGTHS.get(int(image.header["xyzt_units"]) & 7)
    dtype, steps = image.get_data_dtype(), np.abs(image.header.get_zooms()[:3])
    if len(shape) < 3 or any(n != 1 for n in shape[3:]) or dtype.kind not in "iuf":
        raise DataError(f"{path} contains {dtype} of shape {shape}; expected real numbers with three axes.")
    if unit is None or not (np.isfinite(steps).all() and steps.all()):
        stated_unit = image.header["xyzt_units"]
        raise DataError(f"{path} states voxels of {steps} in the unit {stated_unit}; expected lengths.")
    require_room(path, math.prod(shape) * dtype.itemsize)
    values = np.asarray(image.dataobj).T.reshape(shape[2::-1])  # [x, y, z], then any number of axes of length 1
    x, y, z = (float(step) * unit for step in steps)
    scaled = values.dtype.newbyteorder("=") != dtype.newbyteorder("=")
    return values.astype(np.float32 if scaled else dtype.newbyteorder("=")), (z, y, x)


def has_only_a_volume(path: Path) -> bool:
    """Whether an .npz holds a volume of the library (see `Volume.save`), or a single array with three axes."""
    try:
        with zipfile.ZipFile(path) as packed:
            axes = {each.removesuffix(".npy"): _axes_of_member(packed, each) for each in packed.namelist()}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, NotImplementedError):
        return False
    volume = axes.get("volume") if "voxel_mm" in axes else next(iter(axes.values())) if len(axes) == 1 else None
    return volume == 3


def _axes_of_member(packed: zipfile.ZipFile, name: str) -> int | None:
    """Number of axes of an array in an .npz; None if it does not contain numbers."""
    with packed.open(name) as member:
        version = np.lib.format.read_magic(member)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(member)
    return len(shape) if dtype.kind in "uif" else None


def _from_numpy(path: Path, name: str | None) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    arrays = numpy_arrays(path)
    if "" in arrays:
        return arrays[""], None
    name = _only(path, {key: array.ndim for key, array in arrays.items()}) if name is None else name
    if name not in arrays:
        raise DataError(f"{path} has no array {name!r}; it has {', '.join(arrays)}.")
    spacing = arrays.get("voxel_mm")
    if spacing is None or spacing.ndim != 0 or not (np.issubdtype(spacing.dtype, np.floating) and spacing > 0):
        return arrays[name], None
    slices = arrays.get("slice_mm", spacing)
    if float(spacing) == float(slices) == 1:  # the pitch of a `Geometry` that does not state it
        return arrays[name], None
    return arrays[name], (float(slices), float(spacing), float(spacing))


def _from_hdf5(
    path: Path, file: h5py.File, name: str | None
) -> tuple[NDArray[np.generic], tuple[float, float, float] | None]:
    if name is None:
        arrays: dict[str, int] = {}
        file.visititems(
            lambda key, item: (
                arrays.update({key: item.ndim}) if isinstance(item, h5py.Dataset) and item.ndim == 3 else None
            )
        )
        name = _only(path, arrays)
    item = file.get(name)
    if not isinstance(item, h5py.Dataset):
        raise DataError(f"{path} has no dataset {name!r}.")
    require_room(path, item.nbytes)
    return datasets.read_part(item, ()), axes_of(file, name)[0]


def _only(path: Path, axes: dict[str, int]) -> str:
    volumes = [name for name, n in axes.items() if n == 3]
    if len(volumes) != 1:
        # imported here, because the reader of a volume does not need the readers of scans
        from beamline.storage.readers.open import scan_format

        if (scan := scan_format(path)) is not None:
            raise DataError(
                f"{path} is a scan ({scan}), not a volume. `beamline recon {path}` makes a volume of it, "
                f"and `beamline view {path}` shows its frames."
            )
        if not volumes:
            raise DataError(f"{path} contains no array with three axes, so it is not a volume.")
        raise DataError(
            f"{path} contains {len(volumes)} volumes ({', '.join(volumes)}). Choose one with --dataset NAME, "
            "or with FILE::NAME in `beamline view`. Commands without this option need a file with a single volume."
        )
    return volumes[0]
