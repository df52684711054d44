"""FrameTable: a table of all frames of a scan, with a row for each frame and a column for each fact (kind, angle,
time, ...).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.storage.flag_legend import FrameFlags
from drivers.base.frame import Frame, FrameKind
from recon.base.arrays import F64, I64, Mask

_NONE, _FIRST = np.zeros(0, np.int64), np.zeros(1, np.int64)


@dataclass(frozen=True, eq=False)
class FrameTable:
    """The frames of a scan. `take` selects and reorders frames; `concat` joins tables.

    No value is guessed: an unknown value of a frame is NaN or -1, and a column that the scan does not have is None.
    Arrays are never changed: `dataclasses.replace` makes a table with other columns.

    Attributes:
        kinds: int32 [frame], values of FrameKind.
        angles: float64 [frame], radians.
        exposures: float64 [frame], s.
        triggers: int64 [frame], as in `Frame`; -1 if the record of a frame differs from its checksum.
        framestamps: int64 [frame], number that the camera gives to each frame.
        altered: bool [frame], True if the record of the frame differs from its checksum. These frames are INVALID.
        part_starts: int64 [part], ascending, the first row of each part; [0] if the scan was not interrupted. Between
            two parts beam and camera may have changed.
        pass_ends: int64 [pass], rows at the end of each pass of projections; empty if the scan has none.
        times: float64 [frame], s at the trigger.
        replaces: int64 [frame], the row of the projection that a frame repeats (the old row is then INVALID).
        numbers: int64 [frame], number in the file name of each frame.
        aside: float64 [frame], mm, as in `Frame`.
        shifts: float64 [frame, 2], displacement of the image along (columns, rows) in pixels.
        energies: float64 [frame], keV.
        currents: float64 [frame], ring current, or another reading of a beam monitor, in its own unit.
        flags: flags of the monitor.
    """

    kinds: NDArray[np.int32]
    angles: F64
    exposures: F64
    triggers: I64
    framestamps: I64
    altered: Mask
    part_starts: I64 = field(default_factory=_FIRST.copy)
    pass_ends: I64 = field(default_factory=_NONE.copy)
    times: F64 | None = None
    replaces: I64 | None = None
    numbers: I64 | None = None
    aside: F64 | None = None
    shifts: F64 | None = None
    energies: F64 | None = None
    currents: F64 | None = None
    flags: FrameFlags | None = None

    @classmethod
    def of(
        cls, kinds: ArrayLike, angles: F64 | None = None, exposures: F64 | None = None, **columns: Any
    ) -> FrameTable:
        """A table of frames of these kinds. Columns that are not given are unknown. Triggers are counted from 0 in each
        block of frames of one kind.
        """
        kinds = np.array(kinds, np.int32)
        n = kinds.size
        return cls(
            kinds,
            np.full(n, np.nan) if angles is None else angles,
            np.full(n, np.nan) if exposures is None else exposures,
            **{
                "triggers": _count_in_blocks(kinds),
                "framestamps": np.full(n, -1),
                "altered": np.zeros(n, np.bool_),
            }
            | columns,
        )

    def __len__(self) -> int:
        return int(self.kinds.size)

    def of_kind(self, *kinds: int) -> I64:
        """Rows of the frames of these kinds, ascending."""
        return np.flatnonzero(np.isin(self.kinds, kinds))

    @cached_property
    def views(self) -> I64:
        """Rows of the projections."""
        return self.of_kind(FrameKind.PROJECTION)

    @cached_property
    def darks(self) -> I64:
        """Rows of the darks."""
        return self.of_kind(FrameKind.DARK)

    @cached_property
    def flats(self) -> I64:
        """Rows of the flats."""
        return self.of_kind(FrameKind.FLAT)

    @cached_property
    def offset_views(self) -> I64:
        """Rows of the projections for which the sample was moved sideways (laterally offset projections)."""
        return self.of_kind(FrameKind.OFFSET_VIEW)

    @cached_property
    def views_with_angles(self) -> I64:
        """Rows of the projections whose angles are known."""
        return self.views[np.isfinite(self.angles[self.views])]

    @property
    def are_views(self) -> Mask:
        """bool [frame], the projections."""
        return np.asarray(self.kinds == FrameKind.PROJECTION)

    @property
    def replaced(self) -> I64:
        """Rows of the projections that were repeated, ascending."""
        return _NONE if self.replaces is None else np.sort(self.replaces[self.replaces >= 0])

    def views_of(self, first: int, end: int) -> I64:
        """Rows of the projections in a range of rows, for example in one part of the scan."""
        return self.views[slice(*np.searchsorted(self.views, (first, end)))]

    def numbers_taken(self, first: int = 0, kind: int = FrameKind.PROJECTION) -> frozenset[int]:
        """Numbers, from 0, of the planned projections that were taken. A projection taken again has the number of the
        first attempt.

        Args:
            first: the row from which frames count.
            kind: kind of the frames to count.
        """
        rows, numbers = self.of_kind(kind), set[int]()
        for row in rows[rows >= first].tolist():
            while self.replaces is not None and self.replaces[row] >= 0:
                row = int(self.replaces[row])
            numbers.add(int(self.triggers[row]))
        return frozenset(numbers)

    def kind(self, row: int) -> FrameKind:
        """The kind of one frame."""
        return FrameKind(int(self.kinds[row]))

    def has(self, *kinds: int) -> bool:
        """True if there is a frame of each of these kinds."""
        return set(kinds) <= {*self.kinds.tolist()}

    def frame(self, row: int, counts: NDArray[np.uint16], kind: FrameKind | None = None) -> Frame:
        """A frame with all known values. `kind` replaces the kind in the table."""
        return Frame(
            counts=counts,
            kind=self.kind(row) if kind is None else kind,
            index=row,
            trigger=int(self.triggers[row]),
            framestamp=int(self.framestamps[row]),
            angle=float(self.angles[row]),
            time=np.nan if self.times is None else float(self.times[row]),
            exposure=float(self.exposures[row]),
            replaces=-1 if self.replaces is None else int(self.replaces[row]),
            aside=0.0 if self.aside is None else float(np.nan_to_num(self.aside[row])),
        )

    def without(self, rows: I64 | Mask) -> FrameTable:
        """The same frames, with these rows marked INVALID."""
        kinds = self.kinds.copy()
        kinds[rows] = FrameKind.INVALID
        return replace(self, kinds=kinds)

    def take(self, rows: I64) -> FrameTable:
        """The frames of these rows, in this order. If a projection repeats a frame that is not selected, the result no
        longer states that it repeats one.

        If the rows are ascending, parts and passes are those of the selected frames. In any other order, they have no
        meaning.
        """
        own: dict[str, Any] = {
            name: None if (column := getattr(self, name)) is None else column[rows] for name in _ARRAYS
        }
        if self.replaces is not None:
            place = np.full(len(self) + 1, -1)  # index -1 reads the last element, which is -1 (repeats no frame)
            place[rows] = np.arange(rows.size)
            own["replaces"] = place[own["replaces"]]
        starts, ends = np.unique(np.searchsorted(rows, self.part_starts)), np.searchsorted(rows, self.pass_ends)
        starts = starts[(starts < rows.size) | (starts == 0)]  # drops parts of which no frame is selected
        flags = None if self.flags is None else self.flags.of(rows)
        return FrameTable(**own, part_starts=starts, pass_ends=ends, flags=flags)

    @staticmethod
    def concat(tables: Sequence[FrameTable]) -> FrameTable:
        """The frames of all tables, one after the other. Each table is one or several parts. Numbers of files are
        dropped.
        """
        if len(tables) == 1:
            return tables[0]
        sizes = [len(table) for table in tables]
        before = np.cumsum(sizes) - sizes
        columns: dict[str, Any] = {name: _joined([getattr(table, name) for table in tables], sizes) for name in _ARRAYS}
        for name in ("part_starts", "pass_ends"):
            columns[name] = np.concatenate([getattr(table, name) + n for table, n in zip(tables, before, strict=True)])
        # an empty part would begin at the same row as the next part
        columns["part_starts"] = np.unique(columns["part_starts"])
        if (replaces := columns["replaces"]) is not None:
            columns["replaces"] = np.where(replaces < 0, -1, replaces + np.repeat(before, sizes))
        flags = FrameFlags.joined([table.flags for table in tables], sizes)
        return FrameTable(**columns | {"numbers": None, "flags": flags})


def kinds_of(image_keys: NDArray[np.integer[Any]]) -> NDArray[np.int32]:
    """Kinds of frames [frame] from the image keys of NXtomo, or from the codes of this program, which distinguish more
    kinds. Undefined codes become INVALID.
    """
    # files mark an offset projection by the translation of the sample
    known = [kind for kind in FrameKind if kind is not FrameKind.OFFSET_VIEW]
    return np.where(np.isin(image_keys, known), image_keys, FrameKind.INVALID).astype(np.int32)


_ARRAYS = [each.name for each in fields(FrameTable) if each.name not in ("part_starts", "pass_ends", "flags")]


def _joined(each: Sequence[NDArray[Any] | None], sizes: Sequence[int]) -> NDArray[Any] | None:
    """The values [frame, ...] of a column in several tables. A table without the column gives NaN, or -1 for integers.
    None if no table has the column.
    """
    known = next((values for values in each if values is not None), None)
    if known is None:
        return None
    blank = -1 if known.dtype.kind == "i" else np.nan
    return np.concatenate(
        [np.full((n, *known.shape[1:]), blank) if v is None else v for v, n in zip(each, sizes, strict=True)]
    )


def _count_in_blocks(kinds: NDArray[np.int32]) -> I64:
    """The trigger of each frame within its block: 0, 1, 2, ..., starting at each change of kind."""
    rows = np.arange(kinds.size)
    starts = np.where(np.diff(kinds, prepend=kinds[:1] - 1) != 0, rows, 0)
    return rows - np.maximum.accumulate(starts)
