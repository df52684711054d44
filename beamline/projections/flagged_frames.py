"""Flagged frames, darks, flats and views on the way back of a scan, as a report shows them, with reasons in words."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import zip_longest
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import spans
from beamline.monitor.check import Level
from beamline.projections.read import read_binned
from beamline.storage.flag_legend import FlagBit, FrameFlags
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.references import groups_of
from drivers.base.frame import FrameKind
from recon.base.arrays import bin_views
from recon.prep.shift import shift_between

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


MOVED = 0.5
"""Pixels: edges are doubled as far as the resolution, as for the monitor's `motion`."""
_SIDE = 512  # pixels of a view, binned, at most: 0.4 s a view
_BESIDE = 0.5  # pixels that the sample's rim may turn between both
_REFERENCES = 8  # darks and flats that are read


@dataclass(frozen=True)
class ReturnedView:
    """A view on the way back, and the sample's displacement since the first one, on the detector.

    Attributes:
        frame, first: rows of both in the file.
        angle: rad.
        across, down: pixels towards higher columns and rows; NaN: not told by the views.
        sigma: pixels, the larger of their uncertainties by noise.
        pixel_mm: edge of a pixel at the rotation axis; None: not known.
    """

    frame: int
    first: int
    angle: float
    across: float
    down: float
    sigma: float
    pixel_mm: float | None

    @property
    def moved(self) -> bool:
        """Whether the sample is displaced from the first view by more than `MOVED` pixels."""
        return max(abs(x) for x in (self.across, self.down, 0.0) if math.isfinite(x)) > MOVED

    def in_words(self) -> str:
        """The displacement in words."""
        parts = [f"{self._length(x)} {way}" for x, way in ((self.across, "across"), (self.down, "down"))]
        sure = f" (± {self.sigma:.2g} px)" if math.isfinite(self.sigma) else ""
        moved = ", the sample has moved" if self.moved else ""
        pair = f"{round(math.degrees(self.angle), 3) + 0:g}°, frame {self.frame} against {self.first}"
        return f"{pair}: {', '.join(parts)}{sure}{moved}"

    def _length(self, pixels: float) -> str:
        if not math.isfinite(pixels):
            return "not known"
        return f"{pixels:+.2f} px" + ("" if self.pixel_mm is None else f" = {pixels * self.pixel_mm:+.5f} mm")


def returned_views(source: ScanSource) -> list[ReturnedView]:
    """Each view on the way back, compared with the view at the same angle; a view without a counterpart is left out.

    Empty for a scan without darks and flats, and where nobody says what pixels hold.

    Raises:
        DataError: frames cannot be read.
    """
    keys, angles = source.image_key, source.angles
    back, views = (
        np.flatnonzero((keys == kind) & np.isfinite(angles)) for kind in (FrameKind.ALIGNMENT, FrameKind.PROJECTION)
    )
    darks, flats = (groups_of(source, kind) for kind in (FrameKind.DARK, FrameKind.FLAT))
    counts = source.quantity == "counts"
    if not (back.size and views.size) or source.quantity == "unknown" or (counts and not (darks and flats)):
        return []
    binning = max(1, -(-max(source.shape) // _SIDE))

    def read(rows: NDArray[np.int64]) -> NDArray[np.float32]:
        return np.asarray(read_binned(source, rows, slice(0, source.shape[0]), binning), np.float32)

    dark = read(np.concatenate(darks)[:_REFERENCES]).mean(0) if counts else None
    pixel = source.pixel_size_mm
    if pixel is not None and source.cone is not None:
        pixel *= source.cone[0] / source.cone[1]

    def line_integrals(row: int) -> NDArray[np.float32]:
        view = read(np.array([row]))[0]
        if dark is None:
            return view
        light = read(min(flats, key=lambda group: abs(float(np.mean(group)) - row))[:_REFERENCES]).mean(0) - dark
        good = (light > 0) & (view > dark)
        return np.where(good, -np.log(np.where(good, view - dark, 1) / np.where(good, light, 1)), np.nan)

    returned = []
    for row in back.tolist():
        apart = np.abs(np.remainder(angles[views] - angles[row] + np.pi, 2 * np.pi) - np.pi)
        if apart.min() * source.shape[1] / 2 > _BESIDE:
            continue
        first = int(views[apart.argmin()])
        shift = shift_between(line_integrals(first), line_integrals(row))
        unbinned = (binning * shift.across, binning * shift.down)
        sigma = binning * float(np.fmax(shift.across_sigma, shift.down_sigma))
        returned.append(ReturnedView(row, first, float(angles[row]), *unbinned, sigma, pixel))
    return returned
