"""Scans whose projections are the means of several frames."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from beamline.core.errors import ConfigError
from beamline.storage.frame_table import FrameTable
from beamline.storage.hdf5 import UnreadableError
from beamline.storage.readers.base import Attributes, ScanSource, frame_indices, read_known
from beamline.storage.readers.frames import Frames, Read
from drivers.base.frame import FrameKind

JOINED_DEG = "frames_per_view_joined_deg"
"""Attribute of a scan whose frames are averaged: the largest angle between two frames of one projection."""
_MEASURED = ("angles", "times", "aside", "shifts", "energies", "currents")
_EXACT = 2  # bytes of an integer for which the sum over a projection fits into uint32


class AveragedSource(Frames):
    """A ScanSource whose projections are means of several projections of `base`; darks and flats are unchanged, invalid
    frames are omitted.

    A mean combines up to `n` consecutive frames that are closer in angle than frames of different projections.
    Therefore a projection with missing frames never takes frames of its neighbour. In a growing file a projection is
    complete as soon as a frame of the next one, or its n-th frame, exists.

    Frames with an alarm are left out of the mean, unless all frames of the projection have one. Damaged and unreadable
    frames are also left out. Integers are summed as integers, real numbers in float64. The mean is rounded once, to
    float32 (a part in 10^7).
    """

    def __init__(self, base: ScanSource, n: int) -> None:
        """Raises ConfigError if no projection would have more than one frame."""
        self._base, self._n, self._groups = base, n, list[list[int]]()
        super().__init__(
            base,
            pixels=self._mean,
            dtype=np.dtype(np.float32),
            frames_per_view=n,
            frame_bytes=lambda each: each * n,
            table=self._joined,
            attributes=self._and_joined,
            damaged=lambda rows: frozenset(i for i, group in enumerate(self._used) if rows.issuperset(group)),
        )
        if base.plan.get("frames_per_view") == n and "angles_deg" in base.plan:
            self.plan = {**base.plan, "angles_deg": base.plan["angles_deg"][::n]}
        if base.finished and not any(len(group) > 1 for group in self._groups):
            views = base.table.views.size
            raise ConfigError(
                f"Omit --frames-per-view {n}: no two consecutive projections of the {views} in "
                f"{base.path} are at the same angle, so there is nothing to average. Nothing was read."
            )

    def _update(self) -> None:
        keys, flags = self._base.table.kinds, self._base.table.flags
        self._groups += self._since(self._apart(), self._groups[-1][-1] + 1 if self._groups else 0)
        usable = ([row for row in group if keys[row] != FrameKind.INVALID] for group in self._groups)
        self._usable = [rows or group for rows, group in zip(usable, self._groups, strict=True)]
        alarmed = np.zeros(keys.size, np.bool_) if flags is None else flags.alarmed
        self._used = [[row for row in rows if not alarmed[row]] or rows for rows in self._usable]
        super()._update()

    def _joined(self, known: FrameTable) -> FrameTable:
        """The table with the first frame of each projection, and with the means of the measured values."""

        def means(values: NDArray[np.float64] | None) -> NDArray[np.float64] | None:
            if values is None:
                return None
            return np.array([values[rows].mean(axis=0) for rows in self._used]).reshape(-1, *values.shape[1:])

        table = known.take(np.array([group[0] for group in self._groups], np.int64))
        measured: dict[str, Any] = {name: means(getattr(known, name)) for name in _MEASURED}
        return replace(
            table,
            kinds=known.kinds[[rows[0] for rows in self._usable]],
            flags=None if known.flags is None else known.flags.of_groups(self._used),
            altered=np.zeros(len(table), np.bool_),
            replaces=None,  # the frames that these refer to no longer exist
            numbers=None,
            **measured,
        )

    def _apart(self) -> float:
        """Angle in radians from the first frame of a projection, beyond which a frame belongs to the next
        projection.
        """
        table = self._base.table
        planned = np.radians(np.asarray(self._base.plan.get("angles_deg", ()), np.float64))
        angles = planned if planned.size > self._n else table.angles[table.views]
        steps = np.abs(angles[self._n :] - angles[: -self._n])
        steps = steps[np.isfinite(steps) & (steps > 0)]
        return float(np.median(steps)) * (1 - 0.5 / self._n) if steps.size else np.inf

    def _since(self, apart: float, first: int) -> list[list[int]]:
        """The rows of `base` from `first` on, grouped by projection. A projection that may still get frames is left
        out.
        """
        keys, angles, groups = self._base.table.kinds, self._base.table.angles, list[list[int]]()
        view, may_grow = list[int](), False
        for row in (first + np.flatnonzero(keys[first:] != FrameKind.INVALID)).tolist():
            near = may_grow and keys[row] == FrameKind.PROJECTION and not abs(angles[row] - angles[view[0]]) >= apart
            if not near:
                groups.append(view := [])
            view.append(row)
            may_grow = bool(keys[row] == FrameKind.PROJECTION) and len(view) < self._n
        return groups[:-1] if may_grow and not self._base.finished else groups

    def _and_joined(self, known: Attributes) -> Attributes:
        """The scan's attributes, with the number of omitted frames and the largest angle within a projection."""
        angles, out = self._base.table.angles, sum(map(len, self._usable)) - sum(map(len, self._used))
        joined = float(np.degrees(max((np.ptp(angles[rows]) for rows in self._groups if len(rows) > 1), default=0.0)))
        facts = {"frames_per_view": self._n, "frames_left_out_by_alarms": out, JOINED_DEG: joined}
        return {**known, **{name: value for name, value in facts.items() if value}}

    def _mean(self, read: Read, frames: slice | ArrayLike, rows: slice) -> NDArray[Any]:
        base = self._base
        wanted = [self._used[i] for i in frame_indices(frames, len(self._used)).tolist()]
        shape = len(wanted), len(range(self.shape[0])[rows]), self.shape[1]
        whole = base.dtype.kind == "u" and base.dtype.itemsize <= _EXACT
        total, counted = np.zeros(shape, np.uint32 if whole else np.float64), np.zeros(len(wanted))
        for turn in range(max(map(len, wanted), default=0)):
            views = [i for i, group in enumerate(wanted) if turn < len(group)]
            images = read_known(base, [wanted[i][turn] for i in views], rows)
            bad = base.damaged | base.unreadable.keys()
            for i, image in zip(views, images, strict=True):
                if wanted[i][turn] not in bad or bad.issuperset(wanted[i]):  # the last frame, if all have an alarm
                    np.add(total[i], image, out=total[i], casting="unsafe")
                    counted[i] += 1
        for group in wanted:
            if group and base.unreadable.keys() >= set(group):
                raise UnreadableError(base.unreadable[group[0]])
        return (total / np.maximum(counted, 1)[:, None, None]).astype(np.float32)


def stated_frames_per_view(source: ScanSource) -> int:
    """Frames per projection according to the plan in the file; 1 if the file has no plan."""
    stated = source.plan.get("frames_per_view", 1)
    return stated if isinstance(stated, int) and stated > 1 else 1
