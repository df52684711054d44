"""Partial volumes: the finished slabs of a volume, in a file that is readable even if the process is killed.

The file is an NXtomoproc file whose space is completely allocated when the file is created. Voxels are written through
memory maps, so the structure of the file never changes. While a slab is added, the slices that it shares with another
slab are saved separately. If a slab was added only in part, it is removed when the file is opened again.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.files import atomic_file
from beamline.storage import datasets, hdf5
from beamline.storage.disk_file import reserve
from beamline.storage.recon_record import ReconRecord, Value
from beamline.storage.writer_lock import WriterLock, held, opened_whole
from beamline.storage.writers.recon_file import CHANGE, value_of, write_record
from recon.base.json_values import plain
from recon.base.slabs import Slab

_SLABS = "entry/reconstruction/slabs"
_PLACES = {
    "volume": "entry/data/data",
    "done_text": "entry/reconstruction/parameters/partial",
    "state": f"{_SLABS}/state",
    "shared_before": f"{_SLABS}/shared_before",
}
_CHANGE_PLACES = {"change": f"entry/data/{CHANGE}", "change_shared_before": f"{_SLABS}/change_shared_before"}
_BEFORE = {"volume": "shared_before", "change": "change_shared_before"}  # the slices saved while a slab is added
_MISSING, _ADDING, _DONE, _DONE_OTHERWISE = range(4)  # the last one: finished, by another method than the first slab


@dataclass(frozen=True, eq=False)
class PartialVolume:
    """A volume of which some slabs are finished; no other process can add slabs while this object exists.

    Attributes:
        slabs: all slabs of the volume.
        made_from: data and settings, by name. All slabs must be made from the same values.
        kept: other values that the remaining slabs need, in a form that JSON can represent.
    """

    path: Path
    slabs: Sequence[Slab]
    made_from: Mapping[str, Value]
    kept: Mapping[str, Any]
    _maps: Mapping[str, np.memmap[Any, Any]]
    _lock: WriterLock

    @property
    def volume(self) -> NDArray[np.float32]:
        """float32 [z, y, x] as a memory map. Slices of missing slabs are zero."""
        return self._maps["volume"]

    @property
    def change(self) -> NDArray[np.float32] | None:
        """float32 [z, y, x] as a memory map: the volume minus the moved reference; None: there is no reference."""
        return self._maps.get("change")

    def has(self, n: int) -> bool:
        """True if slab n is finished."""
        return bool(self._maps["state"][n] >= _DONE)

    @property
    def n_slices_done(self) -> int:
        """Number of slices of the finished slabs."""
        return sum(slab.own.stop - slab.own.start for n, slab in enumerate(self.slabs) if self.has(n))

    @property
    def made_otherwise(self) -> list[int]:
        """The slices of the slabs that were added with `otherwise`."""
        chosen = np.flatnonzero(self._maps["state"] == _DONE_OTHERWISE).tolist()
        return [z for n in chosen for z in range(self.slabs[n].own.start, self.slabs[n].own.stop)]

    def add(
        self,
        n: int,
        data: NDArray[np.float32] | None,
        *,
        change: NDArray[np.float32] | None = None,
        otherwise: bool = False,
    ) -> None:
        """Store slab n: [z, y, x] of all slices that were reconstructed for it.

        Args:
            data: the volume; None: the slab is zero.
            change: the volume minus the moved reference; None: the slab was reconstructed without a reference.
            otherwise: True if the slab was reconstructed with another method than the first slab.
        """
        slab, state = self.slabs[n], self._maps["state"]
        if data is not None:
            added = {"volume": data}
            if self.change is not None:
                added["change"] = data if change is None else change
            shared = _shared(slab)
            for name in added:
                self._maps[_BEFORE[name]][: len(shared)] = self._maps[name][shared]
                self._written(_BEFORE[name])
            state[n] = _ADDING
            self._written("state")
            for name, values in added.items():
                _blend(self._maps[name], slab, values)
                self._written(name)
        state[n] = _DONE_OTHERWISE if otherwise else _DONE
        self._written("state")
        self._maps["done_text"][0] = f"{self.n_slices_done} of {len(self.volume)} slices"

    def _written(self, name: str) -> None:
        """Return when the data are on the disk, so that no slab is counted that a loss of power could remove."""
        self._maps[name].flush()

    def _take_out(self) -> None:
        """Remove the slab that was only partly added, if there is one."""
        for n in np.flatnonzero(self._maps["state"] == _ADDING).tolist():
            shared = _shared(self.slabs[n])
            for name, before in _BEFORE.items():
                if name in self._maps:
                    self._maps[name][shared] = self._maps[before][: len(shared)]
            self._maps["state"][n] = _MISSING


def create_partial(
    path: Path, record: ReconRecord, slabs: Sequence[Slab], made_from: Mapping[str, Value], kept: Mapping[str, Any]
) -> PartialVolume:
    """Create a file without slabs. The arguments are the attributes of `PartialVolume`, and `record` without its
    voxels. The slabs also have a change if `record` has one.

    Raises:
        DataError: the path exists, or the disk has too little free space. No file is left.
    """
    nz, *shape = record.volume.grid.shape
    with atomic_file(path) as partial:
        write_record(partial, record, empty=True)
        with hdf5.changed(partial) as file:
            file.create_dataset(_PLACES["done_text"], (), "S40", data=f"0 of {nz} slices".encode())
            file[_PLACES["state"]] = np.zeros(len(slabs), np.uint8)
            group = file[_SLABS]
            group["table"] = [[s.own.start, s.own.stop, s.slices.start, s.slices.stop, s.fade] for s in slabs]
            group["kept"] = json.dumps(kept, default=plain, allow_nan=True)  # restored exactly, to the bit
            for name, value in made_from.items():
                group[f"made_from/{name}"] = value
            deepest = max(1, *(len(_shared(slab)) for slab in slabs))
            places = _PLACES if record.change is None else _PLACES | _CHANGE_PLACES
            for place in (places[name] for name in _BEFORE.values() if name in places):
                shared = file.create_dataset(place, (deepest, *shape), np.float32)
                # this allocates the space at the end of the file; HDF5 removes it when it closes the file
                shared[-1, -1, -1] = 0
        with partial.open("r+b") as whole:
            reserve(whole.fileno(), partial.stat().st_size, path.parent)
    return open_partial(path)


def open_partial(path: Path) -> PartialVolume:
    """Open the file to add slabs to it.

    Raises:
        DataError: the file is not a partial volume, it is damaged, or another process is adding slabs to it.
    """
    _refuse_unusable(path)
    lock = WriterLock(path)
    with hdf5.readable(path), opened_whole(path) as file:
        group = file[_SLABS]
        slabs = _slabs_in(group)
        made_from = {name: value_of(node) for name, node in group["made_from"].items()}
        kept = json.loads(group["kept"][()])
        places = _PLACES | (_CHANGE_PLACES if _CHANGE_PLACES["change"] in file else {})
        maps = {
            name: np.memmap(path, item.dtype, "r+", item.id.get_offset(), item.shape or (1,))
            for name, item in ((name, file[place]) for name, place in places.items())
        }
    volume = PartialVolume(path, slabs, made_from, kept, maps, lock)
    volume._take_out()
    return volume


def slabs_of_partial(path: Path) -> tuple[list[Slab], list[Slab]]:
    """All slabs, and the slabs that are not finished.

    Raises:
        DataError: as for `open_partial`.
    """
    _refuse_unusable(path)
    with hdf5.readable(path), opened_whole(path) as file:
        slabs, state = _slabs_in(file[_SLABS]), file[_PLACES["state"]][()]
    return slabs, [slab for slab, is_at in zip(slabs, state, strict=True) if is_at < _DONE]


def _refuse_unusable(path: Path) -> None:
    if not is_partial(path):
        raise DataError(
            f"{path} is not a partial volume. `beamline recon` leaves a partial volume if it is stopped after the "
            "first slab."
        )
    if held(path):
        raise DataError(
            f"{path} is open in another process that writes slabs to it or reads it. Wait until that "
            "process ends. Nothing was changed."
        )


def _slabs_in(group: h5py.Group) -> list[Slab]:
    return [Slab(slice(a, b), slice(c, d), fade) for a, b, c, d, fade in group["table"][()].tolist()]


def is_partial(path: Path) -> bool:
    """True if a file is a partial volume, by its content."""
    if not path.is_file() or not hdf5.is_hdf5(path):
        return False
    try:
        with hdf5.open_hdf5(path) as file:
            return isinstance(datasets.resolve(file, _SLABS), h5py.Group)
    except (DataError, OSError):
        return False


def _blend(volume: NDArray[np.float32], slab: Slab, data: NDArray[np.float32]) -> None:
    """Add the slices of a slab to a volume, each times its share."""
    for z, share, values in zip(range(*slab.slices.indices(len(volume))), slab.share, data, strict=True):
        if share == 1:
            volume[z] = values
        elif share > 0:
            volume[z] += share * values


def _shared(slab: Slab) -> list[int]:
    """The slices of a slab to which another slab also contributes."""
    return [slab.slices.start + k for k, share in enumerate(slab.share) if 0 < share < 1]
