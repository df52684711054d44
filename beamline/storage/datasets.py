"""Datasets of an open HDF5 file: text, numbers with units, links, and frames in any order."""

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
_WRITTEN = re.compile(rf"([-+]?{NUMBER})\s*(.*)")  # a number, and perhaps its unit


def factor_of(unit: str, units: Mapping[str, float]) -> float | None:
    """The factor of a unit, also in capitals, in the plural or with a full stop; None if it is unknown."""
    name = unit.strip(" .").lower().replace("metre", "meter")
    return units.get(name, units.get(name[:-1]) if name.endswith("s") and len(name) > 3 else None)


HELD = 2**28  # bytes of unpacked pieces that are held, so that frames read one by one unpack each piece once
_CACHE, _SLOTS = 2**20, 521  # bytes and places of the cache that every dataset has
_FRAMES, _PIXELS = 10**7, 2**31  # far beyond any scan and detector
_DEEPEST = 12  # groups within another that are looked into
_UNPACKING = 2  # a filter has its input and its output in memory at once (measured: 1.6 to 2.1 chunks)
NAME = 1000  # letters of a name or a title
BRIEF = 2**28  # bytes of a text, a number or a list of a scan


def text(value: Any) -> str:
    """A string from HDF5's representations (str, bytes in UTF-8 or Latin-1, or an array of one of these), without
    control characters.
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
    """A dataset as text; "" if it is missing, or where `text_of` gives ""."""
    item = dataset(group, path)
    return "" if item is None else text_of(item)


def text_of(item: h5py.Dataset) -> str:
    """The first value of a dataset as text."""
    return text(first_of(item))


def arrays_in(file: h5py.File, dimensions: Sequence[int]) -> Iterator[h5py.Dataset]:
    """Each dataset of numbers with this number of dimensions, once, also behind links."""
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
    """The first value of a dataset, which may have many; of an empty dataset nothing."""
    return read_part(item, () if (item.size or 0) <= 1 else (0,) * item.ndim)


def values_of(item: h5py.Dataset) -> Any:
    """All values of a number, a text or a list of a scan. Raises DataError if it has more than BRIEF bytes."""
    if (n := (item.size or 0) * item.dtype.itemsize) > BRIEF:
        raise DataError(
            f"{item.name} in {item.file.filename} contains {n / 1e9:.3g} GB; expected a number, a text or "
            f"a list of at most {BRIEF / 1e9:.3g} GB. Nothing was read."
        )
    return read_part(item, ())


# Filters that The HDF Group has registered and that no package brings on which we depend, by number
FILTERS = {
    305: "LZO", 32002: "MAFISC", 32003: "Snappy", 32005: "APAX", 32006: "CBF", 32007: "JPEG-XR", 32009: "SPDP",
    32010: "LPC-Rice", 32011: "CCSDS-123", 32012: "JPEG-LS", 32014: "fpzip", 32016: "B3D", 32019: "JPEG",
    32020: "VBZ", 32021: "FAPEC", 32022: "BitGroom", 32023: "Granular BitRound", 32025: "Delta-Rice", 32027: "FLAC",
    32029: "TERSE/PROLIX", 32030: "FFMPEG",
}  # fmt: skip


def read_part(item: Any, where: Any) -> Any:
    """`item[where]` of a dataset.

    Raises:
        DataError: a filter with which its values were stored is not installed; the message names it.
        OSError: the values cannot be read for another reason.
    """
    try:
        return item[where]
    except OSError as error:
        stored = getattr(item, "item", item)
        if lacking := next(_not_installed(stored), "") if isinstance(stored, h5py.Dataset) else "":
            folders = os.environ.get("HDF5_PLUGIN_PATH") or "not set"
            raise DataError(
                f"{lacking}, which is not installed here. Put the HDF5 plugin of this filter into a "
                f"folder that HDF5_PLUGIN_PATH names (now {folders}), or, on a computer that has the "
                "filter, write the file without it: h5repack -f NONE. Nothing was changed."
            ) from error
        raise


def _not_installed(item: h5py.Dataset) -> Iterator[str]:
    """Filters that are not installed, of a dataset and of those it refers to, each as the beginning of a sentence."""
    made = item.id.get_create_plist()
    for number, _, _, said in map(made.get_filter, range(made.get_nfilters())):
        if not h5py.h5z.filter_avail(number):
            name = FILTERS.get(number) or one_line(text(said), 40) or "name unknown"
            yield f"{item.name} in {item.file.filename} is stored with the HDF5 filter {number} ({name})"
    for name, where in dict.fromkeys(drawn_on(made)) if item.is_virtual else ():
        with suppress(DataError, OSError, LookupError), _source_file(item, name) as file:
            yield from _not_installed(file[where])


def _source_file(item: h5py.Dataset, name: str) -> AbstractContextManager[h5py.File]:
    """A file that a virtual dataset names, "." for its own."""
    return nullcontext(item.file) if name == "." else open_hdf5(Path(item.file.filename).parent / name)


def piece_of(item: h5py.Dataset) -> int:
    """Bytes that HDF5 decompresses at once: a chunk, or a single value of a dataset without chunks."""
    return (math.prod(item.chunks) if item.chunks else 1) * int(item.dtype.itemsize)


def bytes_unpacked(item: h5py.Dataset, frames: int | None = 0) -> int:
    """Bytes that HDF5 decompresses to read one index of the dimension `frames` of a three-dimensional dataset, or all
    of it (None).
    """
    across = item.chunks or [n if axis != frames else 1 for axis, n in enumerate(item.shape)]
    pieces = [1 if axis == frames else -(-n // m) for axis, (n, m) in enumerate(zip(item.shape, across, strict=True))]
    return math.prod(pieces) * math.prod(across) * int(item.dtype.itemsize)


def resolve(group: h5py.Group, path: str) -> Any | None:
    """The object at a path; None if there is none, e.g. after a link to a missing file or in a circle of links."""
    try:
        return group[path]
    except (KeyError, OSError, RuntimeError):
        return None


def broken_link(group: h5py.Group, path: str) -> str:
    """A sentence if a path ends at a broken link, with the link's target; "" if not."""
    here: Any = group
    for name in path.strip("/").split("/"):
        if not isinstance(here, h5py.Group):
            return ""
        link, there = here.get(name, getlink=True), resolve(here, name)
        if there is None and isinstance(link, h5py.SoftLink | h5py.ExternalLink):
            file = f"{link.filename}::" if isinstance(link, h5py.ExternalLink) else ""
            return f"{here.name.rstrip('/')}/{name} is a link to {file}{link.path}, which does not exist"
        here = there
    return ""


def refuse_broken(group: h5py.Group, path: str) -> None:
    """Raise DataError if a path ends at a broken link."""
    if broken := broken_link(group, path):
        raise DataError(f"{group.file.filename}: {broken}. Put the linked file back next to this one.")


def dataset(group: h5py.Group, path: str, frames: int = 0) -> h5py.Dataset | None:
    """The dataset at a path, unpacked on reading if its numbers are packed; None if it is missing or has a null
    dataspace.

    If frames share chunks with other frames, the unpacked chunks of a frame are kept until the next frame is read; if
    these are too many, those of one row of all frames. `frames` is the number of the frame dimension.

    Raises:
        DataError: a list longer than any scan.
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
        del item  # HDF5 keeps the cache of a dataset that is open
        item = h5py.Dataset(h5py.h5d.open(group.id, path.encode(), access))
    return unpacked(item)


def scalar(group: h5py.Group, path: str, units: Mapping[str, float]) -> float | None:
    """The number in the unit of this program; of a list the median of the positive ones, or else of all.

    None if `in_units` is None, and if no number is finite.
    """
    values = in_units(dataset(group, path), units)
    known = np.empty(0) if values is None else values[np.isfinite(values)]
    return float(np.median(known[known > 0] if (known > 0).any() else known)) if known.size else None


def in_units(item: h5py.Dataset | None, units: Mapping[str, float]) -> NDArray[np.float64] | None:
    """Numbers in the unit of this program, as a list, also if they are written as text, such as "6.5 um".

    None if there is no dataset of real numbers, or if its unit is unknown or missing.
    """
    values, stated = (None, set[str]()) if item is None else _numbers(item)
    factors = {factor_of(unit, units) for unit in stated or {""}}
    factor = factors.pop() if len(factors) == 1 else None  # an attribute and a text that disagree say nothing
    return None if values is None or factor is None else values * factor


def _numbers(item: h5py.Dataset) -> tuple[NDArray[np.float64] | None, set[str]]:
    """The numbers of a dataset as a list (None if it contains none), and the units stated by its attribute and its
    text.
    """
    stated = {attribute(item, "units") or attribute(item, "angle_unit")} - {""}  # the latter of CIL
    if item.dtype.kind in "uif":
        return np.ravel(np.asarray(values_of(item), np.float64)), stated
    if item.dtype.kind not in "SO":
        return None, stated
    written = [_WRITTEN.fullmatch(text(each).strip()) for each in np.ravel(values_of(item))]
    numbers = [match for match in written if match is not None]
    values = np.array([float(match[1]) for match in numbers])
    return values if len(numbers) == len(written) else None, stated | {match[2] for match in numbers} - {""}


def radians(item: h5py.Dataset, unit: str | None = None, default: str = "") -> NDArray[np.float64]:
    """Angles in radians, NaN for those that are not finite; a column becomes a list.

    Args:
        unit: the unit to use, whatever the file states; None: what its attribute `units` and its text state, or
            `default` if they state none.
    """
    if lost := missing_links(item):
        raise DataError(
            f"{item.file.filename} takes its angles from {lost[0]}, which is missing or has another shape than stated."
        )
    where = f"{item.name} in {item.file.filename}"
    angles, stated = _numbers(item)
    if angles is None:
        raise DataError(
            f"{where} contains {_SORTS.get(item.dtype.kind, item.dtype)}; expected integers or real numbers."
        )
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
    """Copy all attributes of an object, with their types and shapes; the target must have none of these names."""
    for name in source.attrs:
        given = source.attrs.get_id(name)
        made = h5py.h5a.create(target.id, name.encode(), given.get_type(), given.get_space())
        if given.get_space().get_simple_extent_type() != h5py.h5s.NULL:
            values = np.empty(given.shape, given.dtype)
            given.read(values)
            made.write(values)


def missing_links(item: h5py.Dataset, whole: dict[tuple[str, str], bool] | None = None) -> list[str]:
    """Sources of a virtual dataset, in other files or in the same one, that cannot be read or differ in shape.

    For such sources HDF5 silently returns fill values (in another file), or crashes or reads for ever (in its own
    file).

    Args:
        whole: datasets that are complete, by file and path: each is opened once, however often it is referred to. A
            dataset that refers to itself is not complete.

    Raises:
        DataError: the numbers of sources are packed, but the dataset itself does not say so.
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
        raise DataError(
            f"{item.name} in {item.file.filename} is a virtual dataset. The values behind it, "
            f"{packed[0]}, are packed (attributes scale_factor, ...), and a virtual dataset returns them "
            "without unpacking. In a copy of the file, give the virtual dataset the same attributes, or "
            "store unpacked values. Nothing was read."
        )
    return sorted(lost)


def _holds(drawn: h5py.Dataset, source: Any) -> bool:
    space = source.src_space
    if not space.shape:
        return _fills(drawn, source)
    return drawn.shape[1:] == space.shape[1:] and space.get_select_bounds()[1][0] < drawn.shape[0]


def _fills(drawn: h5py.Dataset, source: Any) -> bool:
    """True if the shape of a dataset fills its place: some frames, or a stripe or tile of each."""
    place = source.vspace
    extent = place.shape
    if place.get_select_type() == h5py.h5s.SEL_HYPERSLABS and place.is_regular_hyperslab():
        _, _, counts, blocks = place.get_regular_hyperslab()
        extent = tuple(n * block for n, block in zip(counts, blocks, strict=True))
    return [n for n in drawn.shape if n != 1] == [n for n in extent if n != 1]


def require_possible(item: Any) -> int:
    """Bytes of memory that are needed while a chunk of frames [frame, row, col] is unpacked.

    Raises:
        DataError: frames without pixels, or too large for any memory, or for this one.
    """
    if 0 in item.shape[1:]:
        raise DataError(f"{item.name} in {item.file.filename} has frames of {item.shape[1]} x {item.shape[2]} pixels.")
    if item.shape[0] > _FRAMES or item.shape[1] * item.shape[2] > _PIXELS:
        raise DataError(
            f"{item.name} in {item.file.filename} is {' x '.join(map(str, item.shape))}; expected at most {_FRAMES} "
            f"frames of {_PIXELS} pixels."
        )
    stored = getattr(item, "item", item)  # pieces of a Zarr are packed usually
    packed = stored.id.get_create_plist().get_nfilters() if isinstance(stored, h5py.Dataset) else bool(stored.chunks)
    if (needed := _UNPACKING * piece_of(item) if packed else 0) > HELD and needed > (free := free_memory()):
        raise DataError(
            f"{item.name} in {item.file.filename} is stored in chunks of {size(piece_of(item))}: "
            f"unpacking one needs {size(needed)} of memory, and {size(free)} are free. On a computer with "
            "more memory, copy the file with one frame per chunk (h5repack -l CHUNK=...). Nothing was "
            "read."
        )
    return needed


def read_frames(item: h5py.Dataset, indices: NDArray[np.int64], rows: slice, out: NDArray[Any]) -> None:
    """Fill out [frame, row, col] with frames in the requested order; consecutive ones are read at once.

    Raises:
        DataError: the frames cannot be read: damaged or missing chunks, or a compression that is not installed.
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
    """Half-open runs [a, b) of consecutive numbers, in order: 3 4 5 9 -> (3, 6), (9, 10)."""
    parts = np.split(rows, np.flatnonzero(np.diff(rows) != 1) + 1)
    return [(int(part[0]), int(part[-1]) + 1) for part in parts if part.size]


_SORTS = {"c": "complex numbers", "b": "Boolean values", "V": "records", "O": "text", "S": "text", "U": "text"}


def require_real(dtype: np.dtype[Any], what: str) -> None:
    """Raise DataError if pixels, keys or angles are not real numbers, for example text or complex numbers."""
    if dtype.kind not in "uif":
        raise DataError(f"{what} contains {_SORTS.get(dtype.kind, str(dtype))}; expected integers or real numbers.")
