"""The flags of a scan as a finding: alarms are a warning, and an error if too few views are left."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beamline.core.text import count, spans
from beamline.storage.flag_legend import FrameFlags, counted
from beamline.storage.readers.base import ScanSource, rows_replaced
from beamline.storage.rules.finding import Finding
from beamline.storage.rules.treatment import treatment_of
from drivers.base.frame import FrameKind

FEWEST_VIEWS = 10
"""Views without an alarm that a volume takes at least, where some have one: so few are a sketch of the sample."""


def frames_flagged(source: ScanSource, judged: FrameFlags | None = None) -> Iterator[Finding]:
    """Number of flagged frames by check and level, and the rows of those with an alarm.

    Args:
        judged: flags that count in place of the file's.
    """
    flags = source.flags if judged is None else judged
    if flags is None or not flags.flagged.any():
        return
    rows, again = np.flatnonzero(flags.alarmed), rows_replaced(source)
    message = f"The monitor flagged {flags.flagged.sum()} of {flags.bits.size} frames: {counted(flags.counts())}."
    if not rows.size:
        yield Finding("info", "flags", message)
        return
    message += f" Frames with an alarm: {spans(rows.tolist())}."
    if again.size:
        verb = "was" if again.size == 1 else "were"
        message += (
            f" {count(again.size, 'view')} {verb} taken again, and the first (frames {spans(again.tolist())}) not used."
        )
        rows = np.setdiff1d(rows, again)
        if not rows.size:
            yield Finding("info", "flags", f"{message} No other frame has an alarm.")
            return
        message += f" Frames with an alarm beside these: {spans(rows.tolist())}."
    treated = treatment_of(flags, source.image_key == FrameKind.PROJECTION, source.shape)
    n, lost = int(treated.views.sum()), int(treated.left_out.sum())
    if lost and n - lost < FEWEST_VIEWS:
        message += (
            f" {n - lost} of {n} views are left, {FEWEST_VIEWS} are needed: repeat the scan. "
            "`beamline recon --flags ignore` takes all views, flagged ones too."
        )
        yield Finding("error", "flags", message)
        return
    if treated.said:
        message += f" A reconstruction (--flags use): {treated.said}"
    yield Finding("warning", "flags", message)
