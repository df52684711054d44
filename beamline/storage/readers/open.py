"""open_scan: a scan in any format that we read, recognised by what is in it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage import hdf5
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.readers.angle_table import Angles, load_angles, parse_angles, select_rows
from beamline.storage.readers.base import Quantity, ScanSource
from beamline.storage.readers.dxchange import DataExchangeSource, is_data_exchange
from beamline.storage.readers.nexus_places import find
from beamline.storage.readers.nxtomo import NXtomoSource
from beamline.storage.readers.overlay import Overlay
from beamline.storage.readers.tiff import SUFFIXES, TiffSeries, TiffStack, load_images

__all__ = ["Angles", "Images", "NotReadyError", "Quantity", "ScanSource", "open_scan"]

Images = Path | str | NDArray[Any]  # a TIFF, a folder of TIFFs, or an array [frame, row, col]


def open_scan(
    path: Path | str,
    *,
    angles: Angles | None = None,
    angle_rows: str | None = None,
    darks: Images | None = None,
    flats: Images | None = None,
    quantity: Quantity | None = None,
    follow: bool = False,
) -> ScanSource:
    """Open a scan in any format that we read.

    Args:
        path: HDF5 file (NXtomo, Diamond NeXus, Data Exchange), multi-page TIFF, folder or .zip of TIFFs.
        angles: replace the file's: a text file in degrees (one a line), or an array in radians; one angle for each
            projection, or one for each frame.
        angle_rows: "a:b", which rows of these angles (or of the angle file beside a TIFF series) to use.
        darks, flats: replace the file's; they come before its frames.
        quantity: what the pixels are, where the file does not say.
        follow: the file may still be growing; refresh() then finds new frames.

    Raises:
        DataError: not there, not a format that we read, or not consistent; the message says what was found.
        NotReadyError (a DataError, `follow` only): the file is not there yet or just being created; try again.
    """
    path = Path(path)
    if follow and (angles is not None or darks is not None or flats is not None):
        raise DataError(f"{path} cannot be followed with --angles, --darks or --flats: its counts still change.")
    base = _open(path, own_angles=angles is None, follow=follow)
    try:
        table = None if angles is None else load_angles(angles)
        angles_from = str(angles) if isinstance(angles, Path | str) else "The array of angles"
        if table is None and isinstance(base, TiffSeries) and base.angle_text is not None:
            angles_from = f"{base.angle_text[0]} in {path}"
            table = parse_angles(base.angle_text[1], angles_from)
        if angle_rows is not None:
            if table is None:
                raise DataError(f"--angle-rows {angle_rows} needs angles to choose from: give --angles FILE.")
            table = select_rows(table, angle_rows)
        if table is None and darks is None and flats is None and quantity is None:
            return base
        return Overlay(
            base,
            angles=table,
            angles_from=angles_from,
            darks=None if darks is None else load_images(darks),
            flats=None if flats is None else load_images(flats),
            quantity=quantity,
        )
    except BaseException:
        base.close()
        raise


def _open(path: Path, *, own_angles: bool, follow: bool) -> NXtomoSource | DataExchangeSource | TiffSeries | TiffStack:
    if path.is_dir() or (path.is_file() and path.suffix.lower() == ".zip"):
        return TiffSeries(path)
    if path.is_file() and path.suffix.lower() in SUFFIXES:
        return TiffStack(path)
    if path.is_file() and not follow and not _is_hdf5(path):
        raise DataError(f"{path} is neither HDF5 nor TIFF; a scan is one of these, or a folder or .zip of TIFFs.")
    with hdf5.open_hdf5(path, follow) as file:
        nexus, exchange = bool(find(file)), is_data_exchange(file)
    if not nexus and not exchange:
        raise DataError(
            f"{path} holds no scan that we know: neither an NXdetector with frames and an image_key (NXtomo) "
            "nor /exchange/data (Data Exchange)."
        )
    return (
        NXtomoSource(path, follow=follow, own_angles=own_angles)
        if nexus
        else DataExchangeSource(path, own_angles=own_angles)
    )


def _is_hdf5(path: Path) -> bool:
    """By its signature, at the start or after a user block (h5py.is_hdf5 says no to a file that is being written)."""
    with path.open("rb") as file:
        for offset in (0, 512, 1024, 2048):
            file.seek(offset)
            if file.read(8) == b"\x89HDF\r\n\x1a\n":
                return True
    return False
