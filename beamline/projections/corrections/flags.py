"""Flags of the monitor: which views are used, and how much views and parts of them weigh."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from beamline.core.text import count
from beamline.projections.usable_views import Regions, UsableViews
from drivers.base.frame import FrameKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from beamline.storage.flag_legend import FrameFlags
    from beamline.storage.readers.base import ScanSource

WARNED_SHARE = 0.5
"""Weight of a ray in the region of a warning."""
WARNED_WEIGHT = 0.5
"""Weight of a view with a warning: as if its noise had twice the variance. A warning says that the view differs by more
than noise, not that it is wrong, and there are too few views to do without it."""
WIDE = 2.5
"""A gap between the remaining views is reported when it is this many times the widest gap before: two neighbouring
views are missing."""


def usable_views(source: ScanSource, use_flags: bool, judged: FrameFlags | None = None) -> UsableViews:
    """Projections without an alarm, and what they weigh; with `use_flags` False all of them, alike.

    Args:
        judged: flags that count in place of the file's.
    """
    from beamline.storage.rules.treatment import treatment_of

    views, flags = source.image_key == FrameKind.PROJECTION, source.flags if judged is None else judged
    rows = np.flatnonzero(views)
    if flags is None or not flags.flagged.any():
        return UsableViews(rows, flags=flags)
    if not use_flags:
        if not flags.flagged[rows].any():
            return UsableViews(rows, flags=flags)
        alarmed, warned = views & flags.alarmed, views & flags.flagged & ~flags.alarmed
        n = f"{count(int(alarmed.sum()), 'view')} with an alarm and {warned.sum()} with a warning"
        sentence = f"--flags ignore: {n} are used as they are."
        return UsableViews(rows, sentence=sentence, flags=flags)
    treated = treatment_of(flags, views, source.shape)
    if not treated.in_words:
        return UsableViews(rows, flags=flags, jumps=treated.jumps)
    weights = np.where(treated.halved, np.float32(WARNED_WEIGHT), np.float32(1)) if treated.halved.any() else None
    good = np.flatnonzero(views & ~treated.left_out)
    gap = gap_sentence(source, rows, good)
    sentence = f"{treated.in_words}{gap and f' They{gap}.'} --flags ignore takes all alike."
    regions = regions_of(treated.flags, source.shape)
    return UsableViews(good, weights, int(treated.left_out.sum()), sentence, flags, regions, treated.jumps)


def gap_sentence(source: ScanSource, before: NDArray[np.int64], after: NDArray[np.int64]) -> str:
    """ " leave 12° without a view" where the views left have such a gap, which those before had not; else empty."""
    period = np.pi if source.cone is None else 2 * np.pi
    narrow, wide = (_widest_gap(source.angles[some], period) for some in (before, after))
    return f" leave {np.degrees(wide):.3g}° without a view" if wide >= WIDE * narrow else ""


def _widest_gap(angles: NDArray[np.float64], period: float) -> float:
    """Radians between neighbouring views that are furthest apart; views a `period` apart see the same."""
    sorted_angles = np.sort(np.mod(angles[np.isfinite(angles)], period))
    return period if sorted_angles.size == 0 else float(np.diff(sorted_angles, append=sorted_angles[0] + period).max())


def regions_of(flags: FrameFlags, shape: tuple[int, int]) -> Regions:
    """The regions of warnings and alarms in frames of this shape; rays in those of an alarm weigh nothing."""
    from beamline.storage.rules.treatment import boxes_of, flagged_in_part

    if flags.regions is None:
        return Regions(local=np.zeros(flags.bits.size, np.bool_))
    boxes = [
        (frame, box, 0.0 if flags.bits[frame] >> entry.alarm_bit & 1 else WARNED_SHARE)
        for i, entry in enumerate(flags.legend)
        for frame, box in boxes_of(flags, i, entry, shape)
        if box is not None
    ]
    local = flagged_in_part(flags, shape)
    kept = [each for each in boxes if local[each[0]]]
    return Regions(
        np.array([frame for frame, _, _ in kept], np.int64),
        np.array([box for _, box, _ in kept], np.int64).reshape(-1, 4),
        np.array([share for _, _, share in kept], np.float32),
        local,
    )
