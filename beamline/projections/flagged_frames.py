"""Flagged frames, darks and flats of a scan, as a report shows them, with reasons in words."""

from __future__ import annotations

from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import spans
from beamline.monitor.check import Level
from beamline.storage.flag_legend import FlagBit, FrameFlags
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import groups_of
from drivers.base.frame import FrameKind
from recon.base.arrays import bin_views

if TYPE_CHECKING:
    from beamline.report.sheets import FlaggedFrame


MOST = 12
APART = 3  # frames of a kind that are shown are at least so far apart: neighbours look alike
PIXELS = 200  # a side of a picture, about


def reasons(flags: FrameFlags) -> list[str]:
    """One line for each check and level: frames, worst score, meaning; alarms first."""
    lines = []
    for level in (Level.ALARM, Level.WARN):
        for i, entry in enumerate(flags.legend):
            rows = flags.rows(entry, level)
            if not rows.size:
                continue
            worst = ""
            scored = rows if flags.scores is None else rows[np.isfinite(flags.scores[rows, i])]
            if flags.scores is not None and scored.size:
                at = scored[np.argmax(np.abs(flags.scores[scored, i]))]
                worst = f", worst {flags.scores[at, i]:.3g} {entry.unit} in frame {at}"
            name = f"{str(level).capitalize()} ({entry.name})"
            lines.append(f"{name}: frames {spans(rows.tolist())}{worst}: {entry.meaning}.")
    return lines


def worst_frames(source: ScanSource, flags: FrameFlags, most: int = MOST) -> list[FlaggedFrame]:
    """The worst frames of each check and level, alarms first, in the order of the file."""
    ranked = [
        _ranked(flags, i, entry, level) for level in (Level.ALARM, Level.WARN) for i, entry in enumerate(flags.legend)
    ]
    chosen: list[int] = []
    for turn in zip_longest(*(rows for rows in ranked if rows)):
        chosen += [row for row in turn if row is not None and row not in chosen]
    return [_frame(source, flags, row) for row in sorted(chosen[:most])]


def reference_images(source: ScanSource) -> dict[str, NDArray[np.float32]]:
    """Mean dark, means of the first and the last group of flats, and the ratio of these two, by title; binned.

    At most four frames of a group are read. Empty for a scan without counts.
    """
    if source.quantity != "counts":
        return {}
    darks, flats = (groups_of(source, kind) for kind in (FrameKind.DARK, FrameKind.FLAT))
    shown = {"dark": darks[:1], "flats": flats[:1], "last flats": flats[1:][-1:]}
    images = {}
    for title, groups in shown.items():
        for group in groups:
            mean = np.mean([_small(source.read([row])[0]) for row in group[:4]], axis=0, dtype=np.float32)
            images[f"{title} (counts)"] = np.asarray(mean, np.float32)
    if len(images) == len(shown):
        dark, first, last = images.values()
        lit = first - dark > 0.1 * np.median(first - dark)
        images["last flats / first"] = np.where(lit, (last - dark) / np.where(lit, first - dark, 1), np.nan)
    return images


def _ranked(flags: FrameFlags, check: int, entry: FlagBit, level: Level) -> list[int]:
    rows = flags.rows(entry, level)
    if flags.scores is not None:
        rows = rows[np.argsort(-np.abs(flags.scores[rows, check]), kind="stable")]
    apart: list[int] = []
    for row in rows.tolist():
        if all(abs(row - other) >= APART for other in apart):
            apart.append(row)
    return apart[:MOST]


def _frame(source: ScanSource, flags: FrameFlags, row: int) -> FlaggedFrame:
    from beamline.report.sheets import FlaggedFrame  # here, as it loads matplotlib

    angle = float(np.degrees(source.angles[row]))
    kind, replaces = FrameKind(int(source.image_key[row])).name.lower(), source.replaces
    if replaces is not None and (new := np.flatnonzero(replaces == row)).size:
        kind = f"replaced by {new[0]}"
    labels, regions, colour = [], [], "tab:orange"
    for i, entry in enumerate(flags.legend):
        if not flags.bits[row] >> entry.bit & 1:
            continue
        is_alarm = bool(flags.bits[row] >> entry.alarm_bit & 1)
        colour = "tab:red" if is_alarm else colour
        has_score = flags.scores is not None and np.isfinite(flags.scores[row, i])
        score = f" {flags.scores[row, i]:.3g}" if flags.scores is not None and has_score else ""
        labels.append(f"{entry.name} {Level.ALARM if is_alarm else Level.WARN}{score}")
        if flags.regions is not None and flags.regions[row, i, 0] >= 0:
            top, bottom, left, right = flags.regions[row, i].tolist()
            regions.append((top, bottom, left, right))
    title = f"frame {row}, {kind}" + (f", {angle:.1f}°" if np.isfinite(angle) else "")
    return FlaggedFrame(
        _small(source.read([row])[0]), source.shape, title, labels, [(region, colour) for region in regions], colour
    )


def _small(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """Binned until there are few; rows and columns that do not fill a bin go."""
    factor = max(1, min(image.shape[1] // PIXELS, *image.shape))
    return np.asarray(bin_views(np.nan_to_num(image.astype(np.float32))[None], factor)[0])
