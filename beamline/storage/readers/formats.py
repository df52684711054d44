"""The list of the formats of scans, and the one way to open a file of any of them.

`own_scan` reads a scan file of this program at fixed paths, without a search. The formats below are those of other
programs, with the checks that their files need.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Any

import h5py

from beamline.core.errors import DataError
from beamline.core.files import refuse_substitute
from beamline.storage import datasets, hdf5
from beamline.storage.array_file import holds_arrays
from beamline.storage.readers.base import NamedArrays, Opening, ScanFormat, ScanSource
from beamline.storage.readers.own_scan import open_own
from beamline.storage.readers.stacks import datasets_text, open_stacks
from beamline.storage.readers.tiff import FOREIGN, no_image
from beamline.storage.writers import layout
from beamline.storage.writers.recon_file import opened_reconstruction
from drivers.base.frame import FrameKind
from recon.base.registry import Registry, in_folders

# modules in this folder, asked in this order. The first one is asked before the formats in folders, the others after
# them.
REGISTRY = (
    "nxtomo",
    "dxchange",
    "stacks",
)
_OURS = {name: f"beamline.storage.readers.{name}" for name in REGISTRY}
_MODULES = {REGISTRY[0]: _OURS[REGISTRY[0]], **in_folders("beamline.storage.readers", "FORMATS"), **_OURS}


def _fitting(name: str, entry: Any) -> ScanFormat:
    if not isinstance(entry, ScanFormat):
        raise ValueError(f"it is a {type(entry).__name__}; expected a ScanFormat, see beamline.storage.readers.base")
    return entry


FORMATS: tuple[ScanFormat, ...] = tuple(
    Registry("reader", {name: import_module(module).FORMAT for name, module in _MODULES.items()}, _fitting).values()
)
"""Every format that can be read; formats of other packages come last. To add a format, write its module and add its
line to REGISTRY, or to FORMATS of a folder of formats.
"""


def open_file(path: Path, opening: Opening) -> ScanSource:
    """Open the scan of a path.

    Raises:
        DataError: the path has no known format, or it cannot be read.
        NotReadyError: the file is just being created (only with `follow`).
    """
    if path.is_file() and not opening.follow:
        refuse_substitute(path)
    with hdf5.readable(path):
        if (own := open_own(path, opening.follow)) is not None:
            return own
        for kind in FORMATS:
            if kind.recognises(path, opening):
                return kind.open(path, opening)
        if holds_arrays(path):
            return open_stacks(path, None)
    raise _unknown(path)


def open_arrays(path: Path, arrays: NamedArrays) -> ScanSource:
    """Open the scan to which the named arrays of a file belong: with the reader of its format, or as stacks of
    images.
    """
    with hdf5.readable(path):
        if arrays.alone and (own := open_own(path)) is not None:
            if own.holds(arrays.data):
                return own
            own.close()
        sources = (kind.at(path, arrays) for kind in FORMATS)
        return next(source for source in sources if source is not None)  # the reader `stacks` accepts any file


def references_in(path: Path, file: h5py.File, kind: FrameKind) -> ScanSource | None:
    """The scan in an open file that has frames of one kind (dark or flat); None if the file has no such frames."""
    if layout.COMMITTED in file and (own := open_own(path)) is not None:
        if own.table.has(kind):
            return own
        own.close()
    sources = (each.references(path, file, kind) for each in FORMATS)
    return next((source for source in sources if source is not None), None)


def scan_format(path: Path) -> str | None:
    """The name of the format of the scan in an HDF5 file; None if the file is not a scan."""
    with hdf5.readable(path):
        return next((kind.name for kind in FORMATS if kind.recognises(path, Opening())), None)


def _unknown(path: Path) -> DataError:
    """What is wrong with a path that no format recognises, and what to do."""
    if path.suffix.lower() in FOREIGN:
        return DataError(no_image(path, [path.name]))
    if not hdf5.is_hdf5(path):
        return DataError(
            f"{path} is neither HDF5 nor TIFF nor PNG, nor a .txrm, .npy, .npz or Zarr. A scan must be a file in one "
            f"of these formats, or a folder or .zip of images.{_WAYS.get(path.suffix.lower(), '')}"
        )
    known = ", ".join(kind.name for kind in FORMATS)
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        held, is_volume = datasets_text(file), datasets.text_at(file, "entry/definition") == "NXtomoproc"
    if is_volume:
        with opened_reconstruction(path) as record:
            made_by = record.method or "another program"
        return DataError(
            f"{path} is a volume made by {made_by}, not a scan. `beamline view {path}` shows it, and "
            "`beamline export` writes it in another format."
        )
    return DataError(
        f"{path} contains no scan in a known format. {held} Name the datasets of the scan: --data-path, --angles-path, "
        f"--darks-path, --flats-path. Known formats: {known}."
    )


_VOLUME = " The file may be a volume: `beamline view` shows NIfTI volumes."
_WAYS = {".mat": " Save a .mat with -v7.3.", ".nii": _VOLUME, ".gz": _VOLUME}
