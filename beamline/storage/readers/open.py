"""open_scan: opens a scan in any format of the registry; the format is recognised from the content."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.storage.hdf5 import NotReadyError
from beamline.storage.readers.angle_files import Angles, angles_at, assign, load_angles, parse_angles, select_rows
from beamline.storage.readers.averaged import AveragedSource, stated_frames_per_view
from beamline.storage.readers.base import NamedArrays, Opening, Quantity, ScanSource, Stated, read_known
from beamline.storage.readers.formats import open_arrays, open_file
from beamline.storage.readers.formats import scan_format as scan_format
from beamline.storage.readers.frames import Frames
from beamline.storage.readers.no_data import examined, marked_source, no_data_of
from beamline.storage.readers.orders import with_order
from beamline.storage.readers.reference_files import Images, load_images, overlaid, places_of_flats, stated_references
from beamline.storage.readers.side_files import SideFile, read_side_file, side_of, with_side_file
from beamline.storage.readers.transforms import (
    UNPACKED,
    as_unsigned,
    cropped,
    in_parts,
    kinds_and_views,
    only_omits,
    real_type,
    selected,
    turned,
    type_wrapped,
    with_kinds,
)
from drivers.base.frame import FrameKind

__all__ = ["NotReadyError", "Quantity", "ScanSource", "SourceOptions", "open_scan"]

_SIGNED = "i1", "i2", "i4"  # signed types, into which the counts of a camera may not fit
_PIXELS = 2**27  # largest number of pixels of a frame of which all rows are examined


@dataclass(frozen=True, eq=False)
class SourceOptions:
    """A scan file, and replacements for its metadata.

    Attributes:
        path: HDF5 file (NXtomo, Diamond NeXus, Data Exchange), multi-page TIFF, folder or .zip of images, .npy, Zarr,
            .txrm, the folder of a scene of R²-Gaussian.
        quantity: quantity of the pixels, if the file does not state it. Transmission (0 to 1) becomes counts with flats
            of 1 and darks of 0.
        angles: replace the angles in the file. Give a file in degrees (a text with one angle per line, a table with a
            column of angles, an .npy), a list with a unit in an HDF5 file (FILE::NAME if there are several), or an
            array in radians. There is one angle for each projection; or one for each frame, if the order of all frames
            is known; or one for each number of a series of files, from the first number to the last.
        angle_rows: "a:b", the rows of these angles (or of the angle file next to a TIFF series) that belong to the
            projections.
        darks, flats: replace the darks and flats in the file. They come before the frames of the file. Give an array,
            TIFFs, or a separate HDF5 file (FILE::DATASET if it has several datasets).
        data_path: path of the projections [frame, row, col] in an HDF5 file of any layout. In an NXtomo with several
            detectors, path of the frames of one detector.
        darks_path, flats_path: paths of the darks and flats that belong to `data_path`.
        angles_path: path of the angles in any HDF5 file, instead of `angles`.
        angles_unit: "deg" or "rad": unit of the angles from `angles_path` or `angles`. It replaces the unit that the
            file states.
        order: of the dimensions of the projections, such as "row,view,col" for a stack of sinograms, or "view,col" for
            one sinogram; also for a series of image files.
        earlier: finished files of the same scan; their frames come before those of `path`.
        horizontal_axis: True if the rotation axis is parallel to the rows. Frames are then rotated by 90 degrees.
        frames: "darks=0:5,flats=5:10": the kind of frames, by their rows; all others are projections. Names of files in
            a folder then do not decide the kind. "0::2" selects every second projection, see `transforms.selected`.
        then: further files of the same scan, whose frames follow.
        side_file: settings file of the manufacturer, with distances, pixel size, angles and white level; see
            `side_files`.
        cols: (first, end) columns of the detector; the scan is read as if it had no other columns.
        frames_per_view: number of consecutive frames that are averaged to one projection; None: the number in the plan
            of the file.
    """

    path: Path | str
    quantity: Stated | None = None
    angles: Angles | None = None
    angle_rows: str | None = None
    darks: Images | None = None
    flats: Images | None = None
    data_path: str | None = None
    darks_path: str | None = None
    flats_path: str | None = None
    angles_path: str | None = None
    angles_unit: str | None = None
    order: str | None = None
    horizontal_axis: bool = False
    earlier: tuple[Path, ...] = ()
    frames: str | None = None
    then: tuple[Path, ...] = ()
    side_file: Path | None = None
    cols: tuple[int, int] | None = None
    frames_per_view: int | None = 1

    @property
    def stated(self) -> bool:
        """True if the caller states more than the path. Then the path cannot be that of a volume."""
        return any(getattr(self, field.name) is not field.default for field in fields(self)[1:])

    def open(self, *, follow: bool = False) -> ScanSource:
        """Open the scan with these replacements; see `open_scan`."""
        return open_scan(self, follow=follow)


def open_scan(scan: SourceOptions | Path | str, *, follow: bool = False) -> ScanSource:
    """Open a scan in any format of the registry.

    Args:
        scan: its path, or a SourceOptions with replacements.
        follow: the file may still be growing; refresh() then finds new frames.

    Raises:
        DataError: the file does not exist, has no supported format, or contradicts itself. The message says what was
            found.
        ConfigError: columns lie outside the detector, or the number of frames per projection is less than 1.
        NotReadyError (a DataError, `follow` only): the file does not exist yet or is just being created; try again.
    """
    options = scan if isinstance(scan, SourceOptions) else SourceOptions(scan)
    path = Path(options.path)
    _refuse(options, follow)
    base = _base(path, options, follow)
    try:
        return _with_replacements(base, options)
    except DataError as error:
        base.close()
        side = side_of(base) if options.side_file is None else None
        if side is None:
            raise
        raise DataError(
            f"{error} The folder of the scan contains {side.path.name}: add {side.option} to use this file ({side})."
        ) from error
    except BaseException:
        base.close()
        raise


def _base(path: Path, options: SourceOptions, follow: bool) -> ScanSource:
    """The frames of all files, with the kinds that the caller states."""
    kinds, _ = kinds_and_views(options.frames)
    own_angles, given = options.angles is None and options.angles_path is None, (options.darks, options.flats)
    kinds = None if only_omits(kinds) else kinds
    opening = Opening(follow, own_angles, kinds is not None, options.quantity == "counts" and given == (None, None))
    with ExitStack() as opened:

        def file(path: Path) -> ScanSource:
            if options.data_path is None:
                return opened.enter_context(open_file(path, opening))
            data = options.data_path if options.order is None else f"{options.data_path}:{options.order}"
            of_views = options.angles_path if options.angle_rows is None else None
            arrays = NamedArrays(data, options.darks_path, options.flats_path, of_views, own_angles)
            return opened.enter_context(open_arrays(path, arrays))

        base = file(path)
        if options.then:
            base = in_parts([base, *map(file, options.then[:-1])], file(options.then[-1]), path)
        if options.earlier:
            base = in_parts([opened.enter_context(open_file(each, Opening())) for each in options.earlier], base)
        if kinds is not None:
            base = with_kinds(base, kinds)
        opened.pop_all()
    return base


def _with_replacements(base: ScanSource, options: SourceOptions) -> ScanSource:
    """The scan, with the values that the caller states instead of the values in the files."""
    side = None if options.side_file is None else read_side_file(options.side_file)
    if side is not None:
        base = with_side_file(base, side)
    n = stated_frames_per_view(base) if options.frames_per_view is None else options.frames_per_view
    kinds, views = kinds_and_views(options.frames)
    angles, angles_from = _angle_table(options, base, side)
    kept = with_kinds(base, kinds) if kinds is not None and only_omits(kinds) else None
    # frames that are left out are included here
    listed = kept is None or angles is None or angles.size != kept.table.views.size
    base = base if listed or kept is None else kept
    base = with_order(
        base, options.order if options.data_path is None else None, None if angles is None else angles.size
    )
    if angles is not None:
        of_each = n if views is None else views.step or 1
        # if there is one value for each projection, it applies to the frames of the projection
        if angles.size * of_each == base.table.views.size:
            angles = np.repeat(angles, of_each)
        assigned = assign(base, angles, angles_from, of_views=options.angle_rows is not None)
        base = Frames(base, table=lambda known: replace(known, angles=assigned))
    if kinds is not None and kept is not None and listed:
        base = with_kinds(base, kinds)
    if views is not None:
        base = selected(base, views)
    if (base.untyped or base.dtype.str[1:] in _SIGNED) and (dtype := _true_type(base)) is not None:
        base = as_unsigned(base, dtype)
    base = _with_references(base, options, side, replaced=angles is not None)
    if n > 1:
        base = AveragedSource(base, n)
    if options.horizontal_axis:
        base = turned(base)
    return base if options.cols is None else cropped(base, options.cols)


def _with_references(base: ScanSource, options: SourceOptions, side: SideFile | None, *, replaced: bool) -> ScanSource:
    """The scan with the darks, flats and quantity that the caller states. Pixels without data are marked.

    Args:
        replaced: True if the caller states something else about the frames.
    """
    quantity = options.quantity
    darks, flats = stated_references(
        base, quantity, (options.darks, options.flats), None if side is None else side.white
    )
    if base.finished and not base.plan and (no_data := no_data_of(base)) is not None:
        base, counts_photons = marked_source(base, no_data)
        darks = np.zeros((1, *base.shape), base.dtype) if darks is None and counts_photons else darks
    if not replaced and darks is None and flats is None and quantity is None:
        return base
    return overlaid(
        base,
        darks=None if darks is None else load_images(darks, FrameKind.DARK, base.shape),
        flats=None if flats is None else load_images(flats, FrameKind.FLAT, base.shape),
        quantity="counts" if quantity == "transmission" else quantity,
        places=places_of_flats(flats, base.shape, len(base.table)),
    )


def _angle_table(
    options: SourceOptions, base: ScanSource, side: SideFile | None
) -> tuple[NDArray[np.float64] | None, str]:
    """The angles from the caller or from a file next to a TIFF series, and their origin. None: the angles in the scan
    are used.
    """
    table = None if options.angles is None else load_angles(options.angles, options.angles_unit)
    origin = str(options.angles) if isinstance(options.angles, Path | str) else "The array of angles"
    if options.angles_path is not None:
        origin = f"{options.angles_path} in {options.path}"
        table = angles_at(Path(options.path), options.angles_path, options.angles_unit, base.angles_unit)
    if table is None and side is not None and side.angles is not None:
        table, origin = side.angles, str(side.path)
    if table is None and base.angle_text is not None:
        origin = f"{base.angle_text[0]} in {options.path}"
        table = parse_angles(base.angle_text[1], origin)
    if options.angle_rows is not None:
        if table is None:
            raise DataError(f"--angle-rows {options.angle_rows} needs angles to choose from; give --angles FILE.")
        table = select_rows(table, options.angle_rows)
    return table, origin


def _true_type(source: ScanSource) -> np.dtype[Any] | None:
    """The true type of the pixels, if they are real numbers stored as integers, or unsigned counts that overflowed. The
    type can represent all frames. None: the stored type is right.
    """
    if source.dtype.kind == "u":
        shown_images = [each for each in _some_of_each_kind(source) if each.any()]
        types = {real_type(each) for each in shown_images}
        return types.pop() if len(types) == 1 else None
    looked_at = [(images, type_wrapped(images)) for images in _some_of_each_kind(source)]
    dtype = max((each for _, each in looked_at if each is not None), key=lambda each: each.itemsize, default=None)
    fits = dtype is not None and all(images.max() <= np.iinfo(dtype).max for images, _ in looked_at)
    return dtype if fits else None


def _some_of_each_kind(source: ScanSource) -> Iterator[NDArray[Any]]:
    for kind in (FrameKind.PROJECTION, FrameKind.FLAT, FrameKind.DARK):
        frame_numbers = examined(source, kind)
        if frame_numbers.size:
            stride = max(1, source.shape[0] * source.shape[1] // _PIXELS, source.frame_bytes // UNPACKED)
            with suppress(DataError):  # an unreadable frame is reported where it is used
                yield read_known(source, frame_numbers[:1] if stride > 1 else frame_numbers, slice(None, None, stride))


def _refuse(options: SourceOptions, follow: bool) -> None:
    """Raise DataError for options that exclude each other."""
    own = ("angles", "darks", "flats", "data_path", "angles_path")
    replaced = [f"--{name.replace('_', '-')}" for name in own if getattr(options, name) is not None]
    own_kinds = {"horizontal-axis": options.horizontal_axis, "frames": options.frames, "append": options.then}
    replaced += [f"--{name}" for name, given in (own_kinds | {"scanner-file": options.side_file}).items() if given]
    if follow and replaced:
        raise DataError(
            f"{options.path} cannot be followed with {', '.join(replaced)}: such an option replaces data of all "
            "frames, but the scan is still adding frames. Wait until the scan has ended."
        )
    for one, other in (("angles", "angles_path"), ("darks", "darks_path"), ("flats", "flats_path")):
        if getattr(options, one) is not None and getattr(options, other) is not None:
            raise DataError(
                f"--{one} and --{other.replace('_', '-')} state the same thing. Give only one of these options."
            )
    for name, needed in (("darks_path", "data_path"), ("flats_path", "data_path"), ("angles_unit", "angles_path")):
        of_angles = name == "angles_unit" and isinstance(options.angles, Path | str)
        if getattr(options, name) is not None and getattr(options, needed) is None and not of_angles:
            dashed = (f"--{each.replace('_', '-')}" for each in (name, needed))
            raise DataError("{} requires {}: give both, or neither.".format(*dashed))
