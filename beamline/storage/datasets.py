"""Reads datasets of an open HDF5 file: text, numbers with units, links, and frames in any order."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.machine import free_memory
from beamline.core.text import NUMBER, one_line, printable, size
from beamline.storage.hdf5 import UnreadableError, open_hdf5, reason
from beamline.storage.packing import PackedDataset, unpacked
from beamline.storage.structure import drawn_on, plain_name

_JOULE = 1 / 1.602176634e-16  # keV
DEGREE = np.pi / 180
ANGLE_UNITS = {"deg": DEGREE, "degree": DEGREE, "°": DEGREE, "rad": 1.0, "radian": 1.0, "mrad": 1e-3}
LENGTH_UNITS = {  # mm
    "m": 1e3, "meter": 1e3, "cm": 10.0, "centimeter": 10.0, "mm": 1.0, "millimeter": 1.0, "um": 1e-3, "µm": 1e-3,
    "μm": 1e-3, "micron": 1e-3, "micrometer": 1e-3, "nm": 1e-6, "nanometer": 1e-6,
}  # fmt: skip
ENERGY_UNITS = {"ev": 1e-3, "electronvolt": 1e-3, "kev": 1.0, "kiloelectronvolt": 1.0, "j": _JOULE, "joule": _JOULE}
WAVELENGTH_UNITS = {"angstrom": 1.0, "å": 1.0, "a": 1.0, "nm": 10.0, "nanometer": 10.0, "pm": 0.01, "m": 1e10}  # Å
TIME_UNITS = {"s": 1.0, "sec": 1.0, "second": 1.0, "ms": 1e-3, "millisecond": 1e-3, "us": 1e-6}  # s
_WRITTEN = re.compile(rf"([-+]?{NUMBER})\s*(.*)")  # a number, perhaps followed by its unit


def factor_of(unit: str, units: Mapping[str, float]) -> float | None:
    """The factor of a unit, also in capitals, in the plural or with a full stop; None if it is unknown."""
    name = unit.strip(" .").lower().replace("metre", "meter")
    return units.get(name, units.get(name[:-1]) if name.endswith("s") and len(name) > 3 else None)


# bytes of decompressed chunks that stay in memory, so that reading frame by frame decompresses each chunk only once
HELD = 2**28
_CACHE, _SLOTS = 2**20, 521  # bytes, and hash slots, of the cache that HDF5 gives to every dataset
# most frames of a scan, and most pixels of a frame; far above any real scan and detector
_FRAMES, _PIXELS = 10**7, 2**31
_DEEPEST = 12  # levels of groups that are searched
_UNPACKING = 2  # a filter has its input and its output in memory at the same time (measured: 1.6 to 2.1 chunks)
NAME = 1000  # largest number of letters of a name or a title
BRIEF = 2**28  # largest number of bytes of a text, a number or a list


def text(value: Any) -> str:
    """A string from any form in which HDF5 returns it: str, bytes in UTF-8 or Latin-1, or an array with one of these.
    Control characters are removed.
    """
    if isinstance(value, np.ndarray):
        value = value.reshape(-1)[0] if value.size else ""
    raw = value if isinstance(value, bytes) else str(value).encode("utf-8", "surrogateescape")
    try:
        return printable(raw.decode().expandtabs(1))
    except UnicodeDecodeError:
        return printable(raw.decode("latin-1").expandtabs(1))


def attribute(item: h5py.HLObject, name: str) -> str:
    """An attribute as text; "" if it is missing."""
    return text(item.attrs[name]) if name in item.attrs else ""


def text_at(group: h5py.Group, path: str) -> str:
    """A dataset as text; "" if the dataset is missing, or if `text_of` returns ""."""
    item = dataset(group, path)
    return "" if item is None else text_of(item)


def text_of(item: h5py.Dataset) -> str:
    """The first value of a dataset as text."""
    return text(first_of(item))


def arrays_in(file: h5py.File, dimensions: Sequence[int]) -> Iterator[h5py.Dataset]:
    """Yields each dataset of numbers that has one of these numbers of dimensions. Links are followed, and each dataset
    is returned once.
    """
    seen, groups = set(), [(file["/"], 0)]
    while groups:
        group, depth = groups.pop()
        for name in group:
            item = resolve(group, name)
            if item is None or (known := h5py.h5o.get_info(item.id)) is None:
                continue
            place = (known.fileno, known.addr)
            if place in seen:
                continue
            seen.add(place)
            if isinstance(item, h5py.Group) and depth < _DEEPEST:
                groups.append((item, depth + 1))
            elif isinstance(item, h5py.Dataset) and item.dtype.kind in "uif" and item.ndim in dimensions:
                yield unpacked(item)


def first_of(item: h5py.Dataset) -> Any:
    """The first value of a dataset. An empty dataset gives an empty array."""
    return read_part(item, () if (item.size or 0) <= 1 else (0,) * item.ndim)


def values_of(item: h5py.Dataset) -> Any:
    """All values of a dataset that contains a number, a text or a list. Raises DataError if the dataset has more than
    BRIEF bytes.
    """
    if (n := (item.size or 0) * item.dtype.itemsize) > BRIEF:
        size_gb = n / 1e9
        limit_gb = BRIEF / 1e9
        raise DataError(
            f"{item.name} in {item.file.filename} contains {size_gb:.3g} GB; expected a number, a text or a list of "
            f"at most {limit_gb:.3g} GB. Nothing was read."
        )
    return read_part(item, ())


# Filters that are registered with The HDF Group, but that are not in any package on which this program depends, by
# number
FILTERS = {
    305: "LZO", 32002: "MAFISC", 32003: "Snappy", 32005: "APAX", 32006: "CBF", 32007: "JPEG-XR", 32009: "SPDP",
    32010: "LPC-Rice", 32011: "CCSDS-123", 32012: "JPEG-LS", 32014: "fpzip", 32016: "B3D", 32019: "JPEG",
    32020: "VBZ", 32021: "FAPEC", 32022: "BitGroom", 32023: "Granular BitRound", 32025: "Delta-Rice", 32027: "FLAC",
    32029: "TERSE/PROLIX", 32030: "FFMPEG",
}  # fmt: skip


def read_part(item: Any, where: Any) -> Any:
    """Read `item[where]`.

    Raises:
        DataError: the values were stored with a filter that is not installed; the message names the filter.
        OSError: the values cannot be read for another reason.
    """
    try:
        return item[where]
    except OSError as error:
        stored = getattr(item, "item", item)
        if lacking := next(_not_installed(stored), "") if isinstance(stored, h5py.Dataset) else "":
            folders = os.environ.get("HDF5_PLUGIN_PATH") or "not set"
            raise DataError(
                f"{lacking}, which is not installed here. Put the HDF5 plugin of this filter into a folder that "
                f"HDF5_PLUGIN_PATH names (now {folders}), or, on a computer that has the filter, write the file "
                "without the filter: h5repack -f NONE. Nothing was changed."
            ) from error
        raise


def _not_installed(item: h5py.Dataset) -> Iterator[str]:
    """The filters that a dataset, or a source of a virtual dataset, needs and that are not installed. Each is the
    beginning of a sentence.
    """
    properties = item.id.get_create_plist()
    for number, _, _, filter_name in map(properties.get_filter, range(properties.get_nfilters())):
        if not h5py.h5z.filter_avail(number):
            name = FILTERS.get(number) or one_line(text(filter_name), 40) or "name unknown"
            yield f"{item.name} in {item.file.filename} is stored with the HDF5 filter {number} ({name})"
    for name, where in dict.fromkeys(drawn_on(properties)) if item.is_virtual else ():
        with suppress(DataError, OSError, LookupError), _source_file(item, name) as file:
            yield from _not_installed(file[where])


def _source_file(item: h5py.Dataset, name: str) -> AbstractContextManager[h5py.File]:
    """The file of a source of a virtual dataset; "." is the file that contains the virtual dataset."""
    return nullcontext(item.file) if name == "." else open_hdf5(Path(item.file.filename).parent / name)


def piece_of(item: h5py.Dataset) -> int:
    """Number of bytes that HDF5 decompresses at once: those of a chunk, or of a single value if the dataset has no
    chunks.
    """
    return (math.prod(item.chunks) if item.chunks else 1) * int(item.dtype.itemsize)


def bytes_unpacked(item: h5py.Dataset, frames: int | None = 0) -> int:
    """Number of bytes that HDF5 decompresses to read one index of the dimension `frames` of a three-dimensional
    dataset. None: to read the whole dataset.
    """
    across = item.chunks or [n if axis != frames else 1 for axis, n in enumerate(item.shape)]
    pieces = [1 if axis == frames else -(-n // m) for axis, (n, m) in enumerate(zip(item.shape, across, strict=True))]
    return math.prod(pieces) * math.prod(across) * int(item.dtype.itemsize)


def resolve(group: h5py.Group, path: str) -> Any | None:
    """The object at a path. None if there is no object, for example because a link points to a missing file, or because
    links form a circle.
    """
    try:
        return group[path]
    except (KeyError, OSError, RuntimeError):
        return None


def broken_link(group: h5py.Group, path: str) -> str:
    """A sentence that names the target of the broken link at which a path ends; "" if no link is broken."""
    item: Any = group
    for name in path.strip("/").split("/"):
        if not isinstance(item, h5py.Group):
            return ""
        link, target = item.get(name, getlink=True), resolve(item, name)
        if target is None and isinstance(link, h5py.SoftLink | h5py.ExternalLink):
            file = f"{link.filename}::" if isinstance(link, h5py.ExternalLink) else ""
            return f"{item.name.rstrip('/')}/{name} is a link to {file}{link.path}, which does not exist"
        item = target
    return ""


def refuse_broken(group: h5py.Group, path: str) -> None:
    """Raise DataError if a path ends at a broken link."""
    if broken := broken_link(group, path):
        raise DataError(
            f"{group.file.filename}: {broken}. The link points to another file: put that other file back into the "
            f"folder of {group.file.filename}."
        )


def dataset(group: h5py.Group, path: str, frames: int = 0) -> h5py.Dataset | None:
    """The dataset at a path. Packed numbers are unpacked when they are read. None if the dataset is missing or has a
    null dataspace.

    A chunk may contain several frames. Then the decompressed chunks of a frame stay in memory until the next frame is
    read. If these chunks have more than HELD bytes, only the chunks of one row of all frames stay in memory. `frames`
    is the index of the dimension that counts frames.

    Raises:
        DataError: the dataset is a list that is longer than any scan.
    """
    item = resolve(group, path)
    if item is None or getattr(item, "shape", None) is None:
        return None
    if item.ndim == 1 and item.size > _FRAMES:
        raise DataError(f"{item.name} in {item.file.filename} has {item.size} values; expected at most {_FRAMES}.")
    several = isinstance(item, h5py.Dataset) and item.ndim == 3 and item.chunks is not None and item.chunks[frames] > 1
    sizes = (bytes_unpacked(item, axis) for axis in (frames, int(not frames))) if several else ()
    if (kept := next((size for size in sizes if size <= HELD), 0)) > _CACHE:
        access = h5py.h5p.create(h5py.h5p.DATASET_ACCESS)
        access.set_chunk_cache(max(_SLOTS, 8 * kept // piece_of(item)), kept, 0.75)
        del item  # HDF5 keeps the cache settings of a dataset as long as the dataset is open
        item = h5py.Dataset(h5py.h5d.open(group.id, path.encode(), access))
    return unpacked(item)


def scalar(group: h5py.Group, path: str, units: Mapping[str, float]) -> float | None:
    """The number at a path, in the unit of this program. If the dataset is a list, the median of its positive numbers,
    or of all numbers if none is positive.

    None if `in_units` returns None, or if no number is finite.
    """
    values = in_units(dataset(group, path), units)
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known[known > 0] if (known > 0).any() else known)) if known.size else None


def in_units(item: h5py.Dataset | None, units: Mapping[str, float]) -> NDArray[np.float64] | None:
    """The numbers of a dataset as a list, in the unit of this program. They may be written as text, such as "6.5 um".

    None if there is no dataset of real numbers, or if its unit is unknown or missing.
    """
    values, stated = (None, set[str]()) if item is None else _numbers(item)
    factors = {factor_of(unit, units) for unit in stated or {""}}
    # if the attribute and the text state different units, the unit is unknown
    factor = factors.pop() if len(factors) == 1 else None
    return None if values is None or factor is None else values * factor


def _numbers(item: h5py.Dataset) -> tuple[NDArray[np.float64] | None, set[str]]:
    """The numbers of a dataset as a list (None if it contains none), and the units stated by its attribute and its
    text.
    """
    stated = {attribute(item, "units") or attribute(item, "angle_unit")} - {""}  # CIL writes `angle_unit`
    if item.dtype.kind in "uif":
        return np.ravel(np.asarray(values_of(item), np.float64)), stated
    if item.dtype.kind not in "SO":
        return None, stated
    written = [_WRITTEN.fullmatch(text(each).strip()) for each in np.ravel(values_of(item))]
    numbers = [match for match in written if match is not None]
    values = np.array([float(match[1]) for match in numbers])
    return values if len(numbers) == len(written) else None, stated | {match[2] for match in numbers} - {""}


def radians(item: h5py.Dataset, unit: str | None = None, default: str = "") -> NDArray[np.float64]:
    """The angles of a dataset in radians, as a list; NaN for values that are not finite.

    Args:
        unit: the unit to use, whatever the file states. None: the unit that the attribute `units` or the text states,
            or `default` if neither states a unit.
    """
    if lost := missing_links(item):
        linked_file = lost[0]
        raise DataError(
            f"{item.file.filename} takes its angles from {linked_file}, which is missing or has another shape than "
            "stated."
        )
    where = f"{item.name} in {item.file.filename}"
    angles, stated = _numbers(item)
    if angles is None:
        type_name = _SORTS.get(item.dtype.kind, item.dtype)
        raise DataError(f"{where} contains {type_name}; expected integers or real numbers.")
    unit = unit or " and ".join(sorted(stated)) or default
    factor = factor_of(unit, ANGLE_UNITS)
    if factor is None:
        raise DataError(
            f"{where} has {f'the units {unit!r}' if unit else 'no attribute units'}; expected degrees or "
            "radians. Set the attribute, give --angles FILE (degrees, one per line), or add "
            "--angles-unit deg or rad to --angles-path."
        )
    return np.where(np.isfinite(angles), angles * factor, np.nan)


def copy_attributes(source: h5py.HLObject, target: h5py.HLObject) -> None:
    """Copy all attributes of an object, with their types and shapes. The target must not have attributes with these
    names.
    """
    for name in source.attrs:
        given = source.attrs.get_id(name)
        copy = h5py.h5a.create(target.id, name.encode(), given.get_type(), given.get_space())
        if given.get_space().get_simple_extent_type() != h5py.h5s.NULL:
            values = np.empty(given.shape, given.dtype)
            given.read(values)
            copy.write(values)


def missing_links(item: h5py.Dataset, whole: dict[tuple[str, str], bool] | None = None) -> list[str]:
    """The sources of a virtual dataset that cannot be read or have another shape. Sources may be in other files or in
    the same file.

    HDF5 does not report such sources. If the source is in another file, HDF5 returns fill values. If it is in the same
    file, HDF5 crashes or never stops reading.

    Args:
        whole: the datasets found to be complete so far, by file and path, so that each dataset is opened only once. A
            dataset that refers to itself is not complete.

    Raises:
        DataError: the numbers of a source are packed, but the attributes of the virtual dataset do not say so.
    """
    drawn, packed, lost, whole = dict[tuple[str, str], list[Any]](), list[str](), set(), {} if whole is None else whole
    for each in item.virtual_sources() if item.is_virtual else ():
        drawn.setdefault((plain_name(each.file_name), plain_name(each.dset_name)), []).append(each)
    for (name, where), places in drawn.items():
        path = Path(item.file.filename) if name == "." else Path(item.file.filename).parent / name
        key = os.path.realpath(path), where
        with suppress(DataError, OSError), _source_file(item, name) as file:
            source = dataset(file, where)
            if isinstance(source, PackedDataset) and not isinstance(item, PackedDataset):
                packed.append(f"{where} in {path}")
            if source is not None and all(_holds(source, place) for place in places):
                if key not in whole:
                    whole[key] = False
                    whole[key] = not missing_links(source, whole)
                if whole[key]:
                    continue
        lost.add(where if name == "." else str(path))
    if packed:
        first_packed = packed[0]
        raise DataError(
            f"{item.name} in {item.file.filename} is a virtual dataset. The values behind it, {first_packed}, are "
            "packed (attributes scale_factor, ...), and a virtual dataset returns packed values without unpacking "
            "them. In a copy of the file, give the virtual dataset the same attributes, or store unpacked values. "
            "Nothing was read."
        )
    return sorted(lost)


def _holds(drawn: h5py.Dataset, source: Any) -> bool:
    space = source.src_space
    if not space.shape:
        return _fills(drawn, source)
    return drawn.shape[1:] == space.shape[1:] and space.get_select_bounds()[1][0] < drawn.shape[0]


def _fills(drawn: h5py.Dataset, source: Any) -> bool:
    """True if a source fills the part of the virtual dataset that it is assigned to: some frames, or a stripe or tile
    of each frame.
    """
    place = source.vspace
    extent = place.shape
    if place.get_select_type() == h5py.h5s.SEL_HYPERSLABS and place.is_regular_hyperslab():
        _, _, counts, blocks = place.get_regular_hyperslab()
        extent = tuple(n * block for n, block in zip(counts, blocks, strict=True))
    return [n for n in drawn.shape if n != 1] == [n for n in extent if n != 1]


def require_possible(item: Any) -> int:
    """Bytes of memory that are needed while a chunk of frames [frame, row, col] is unpacked.

    Raises:
        DataError: the frames have no pixels, or they are larger than any detector or than the free memory.
    """
    if 0 in item.shape[1:]:
        n_rows = item.shape[1]
        n_cols = item.shape[2]
        raise DataError(f"{item.name} in {item.file.filename} has frames of {n_rows} x {n_cols} pixels.")
    if item.shape[0] > _FRAMES or item.shape[1] * item.shape[2] > _PIXELS:
        item_shape = " x ".join(map(str, item.shape))
        raise DataError(
            f"{item.name} in {item.file.filename} has {item_shape} values; expected at most {_FRAMES} frames of "
            f"{_PIXELS} pixels."
        )
    stored = getattr(item, "item", item)  # chunks of a Zarr are usually compressed
    packed = stored.id.get_create_plist().get_nfilters() if isinstance(stored, h5py.Dataset) else bool(stored.chunks)
    if (needed := _UNPACKING * piece_of(item) if packed else 0) > HELD and needed > (free := free_memory()):
        chunk_size = size(piece_of(item))
        raise DataError(
            f"{item.name} in {item.file.filename} is stored in chunks of {chunk_size}: unpacking one chunk needs "
            f"{size(needed)} of memory, and {size(free)} are free. On a computer with more memory, copy the file with "
            "one frame per chunk (h5repack -l CHUNK=...). Nothing was read."
        )
    return needed


def read_frames(item: h5py.Dataset, indices: NDArray[np.int64], rows: slice, out: NDArray[Any]) -> None:
    """Fill `out` [frame, row, col] with frames in the requested order. Consecutive frames are read together.

    Raises:
        DataError: the frames cannot be read, because chunks are damaged or missing, or because a filter is not
            installed.
    """
    start = 0
    for first, end in runs(indices):
        try:
            out[start : start + end - first] = read_part(item, (slice(first, end), rows))
        except OSError as error:
            which = f"Frame {first}" if end == first + 1 else f"One of the frames {first} to {end - 1}"
            raise UnreadableError(
                f"{which} of {item.name} in {item.file.filename} cannot be read ({reason(error)})."
            ) from error
        start += end - first


def runs(rows: NDArray[np.integer]) -> list[tuple[int, int]]:
    """Yields the runs [a, b) of consecutive numbers, in order; b is not part of the run. Example: 3 4 5 9 gives (3, 6),
    (9, 10).
    """
    parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [(int(part[0]), int(part[-1]) + 1) for part in parts if part.size]


_SORTS = {"c": "complex numbers", "b": "Boolean values", "V": "records", "O": "text", "S": "text", "U": "text"}


def require_real(dtype: np.dtype[Any], what: str) -> None:
    """Raise DataError if pixels, keys or angles are not real numbers, for example text or complex numbers."""
    if dtype.kind not in "uif":
        type_name = _SORTS.get(dtype.kind, str(dtype))
        raise DataError(f"{what} contains {type_name}; expected integers or real numbers.")
