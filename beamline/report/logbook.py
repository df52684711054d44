"""A logbook page: a reconstruction on a sheet of A4, as PDF: what it is of, how it was made, what is wrong with it."""

from __future__ import annotations

import io
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import RendererAgg
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from numpy.typing import NDArray

from beamline.core.files import write_whole
from beamline.core.version import version
from beamline.report.figures import bright_centre, grey_window, planes
from beamline.report.html import Report
from beamline.report.metrics import METRICS, formatted
from recon.base.volume import Volume

_PAGE = 8.27, 11.69  # inches, A4
_MARGIN, _GAP = 0.55, 0.14
_FINE = 300  # dots an inch, at which widths are measured
_SIZE, _SMALL = 7.5, 6.5  # points
_FINEST = 900  # pixels of a slice along a side
_WINDOWS = ((1.0, 99.5, "all"), (2.0, 90.0, "low contrast"))  # percentiles
_FLAG_LINES = 12  # that slices leave to flags, if there are so many
_THIN = 0.06  # a slice with a smaller ratio of height to width is stretched
_LEAST, _CAPTION = 0.12, 1.1  # inches: the smallest slice, and what its caption needs
_TABLE_LINES, _LINES_EACH = 18, 3  # rows of the tables, and lines that one value may take


def _line(size: float, factor: float = 1.3) -> float:
    """Height of a line of text, inches."""
    return size * factor / 72


_HEADING = _line(_SIZE, 0.9) + _line(_SIZE + 1)  # inches

_SETTINGS = {
    "method": "method", "chosen": "chosen", "axis_col": "rotation axis (column)", "axis_source": "axis by",
    "tilt": "tilt", "distortion_factors": "lens", "views": "views", "rows": "rows", "roi": "region",
    "binning": "binning", "flags": "flags", "views_left_out": "views left out", "jumps": "jumps", "flats": "flats",
    "noise": "noise", "phase": "phase", "hardening": "hardening", "rings_removed": "rings removed", "rings": "rings",
    "filter": "filter",
}  # fmt: skip
"""Settings that are shown, if there are such, by their labels."""


def write_logbook(path: Path, report: Report, volume: Volume, unit: str, now: float, *, replace: bool = False) -> None:
    """Write the page to `path`, completely or not at all.

    Args:
        report: whose title, summary, facts, figures, flags and command are shown; its pictures are not.
        volume: in 1/unit.
        now: epoch seconds, for the date.

    Raises:
        DataError: if `path` exists and `replace` is not set.
    """
    write_whole(path, as_pdf(logbook(report, volume, unit, now)), replace=replace)


def as_pdf(figure: Figure) -> bytes:
    """The page as PDF, the same bytes for the same page."""
    out = io.BytesIO()
    about = {"Creator": f"splatline {version()}", "Producer": None, "CreationDate": None}
    figure.savefig(out, format="pdf", dpi=300, metadata=about)
    return out.getvalue()


def logbook(report: Report, volume: Volume, unit: str, now: float) -> Figure:
    """The page as a figure, see `write_logbook`. What does not fit is cut with a word about it."""
    page = _Page()
    date = datetime.fromtimestamp(now, UTC).strftime("%Y-%m-%d %H:%M UTC")
    page.lines([report.title], size=13, weight="bold", most=2)
    page.space(0.5)
    page.lines([f"{date} · splatline {version()}"], size=_SMALL, color="0.35")
    page.lines([report.summary], most=6)
    page.space()
    top = page.y
    half = (page.wide - 2 * _GAP) / 2
    page.table("Scan", {**report.scan, "frames": report.frames}, half, most=_TABLE_LINES)
    left = page.y
    page.y = top
    method = {label: report.settings[name] for name, label in _SETTINGS.items() if report.settings.get(name)}
    page.table("Method", method, half, at=_MARGIN + half + 2 * _GAP, most=_TABLE_LINES)
    page.y = min(left, page.y)
    page.figures(report.metrics)
    command = page.wrapped(report.command, page.wide, _SMALL, family="monospace")
    below = _HEADING + len(command) * _line(_SMALL)
    flags = [line for flag in report.flags or ["None."] for line in page.wrapped(f"• {flag}", page.wide, _SIZE)]
    wanted = _HEADING + min(len(flags), _FLAG_LINES) * _line(_SIZE)
    page.slices(volume, unit, page.y - _MARGIN - below - wanted)
    room = max(int((page.y - _MARGIN - below - _HEADING) / _line(_SIZE) + 1e-6), 1)
    if len(flags) > room:
        flags = [*flags[: room - 1], f"... and more, {len(flags) - room + 1} lines of {len(flags)}: see the report."]
    page.heading("Remarks")
    page.raw(flags, _SIZE)
    page.heading("To repeat")
    page.raw(command, _SMALL, family="monospace")
    return page.figure


class _Page:
    """A page that is filled from its top: `y` is how far, in inches from its foot."""

    def __init__(self) -> None:
        self.figure = Figure(figsize=_PAGE)
        self.wide, self.y = _PAGE[0] - 2 * _MARGIN, _PAGE[1] - _MARGIN

    def space(self, share: float = 1.0) -> None:
        self.y -= share * _GAP

    def raw(self, lines: Sequence[str], size: float = _SIZE, at: float = _MARGIN, **style: Any) -> None:
        """Lines as they are."""
        for line in lines:
            self.y -= _line(size)
            self._text(at, self.y, line, size, style)

    def lines(self, texts: Sequence[str], size: float = _SIZE, most: int = 99, **style: Any) -> None:
        """Texts, wrapped, each of so many lines at most."""
        for text in texts:
            self.raw(self.cut(self.wrapped(text, self.wide, size, **style), most), size, **style)

    def heading(self, text: str, at: float = _MARGIN) -> None:
        self.y -= _line(_SIZE, 0.9)
        self.raw([text], _SIZE + 1, at, weight="bold", color="tab:blue")

    def table(self, title: str, values: Mapping[str, str], wide: float, at: float = _MARGIN, most: int = 99) -> None:
        """Names and values below a heading, in so many lines at most."""
        self.heading(title, at)
        label = 0.43 * wide
        rows = [
            (
                self.cut(self.wrapped(name, label - 0.05, _SIZE), 1)[0],
                self.cut(self.wrapped(value, wide - label, _SIZE), _LINES_EACH),
            )
            for name, value in values.items()
            if value
        ]
        left = most
        for n, (name, lines) in enumerate(rows):
            more = len(rows) - n
            if len(lines) + (more > 1) > left:
                self.raw([f"... and {more} more: see the report"], _SIZE, at, color="0.35")
                return
            self._text(at, self.y - _line(_SIZE), name, _SIZE, {"color": "0.35"})
            self.raw(lines, _SIZE, at + label)
            left -= len(lines)

    def figures(self, metrics: Mapping[str, Mapping[str, float]]) -> None:
        """Figures of merit, a column for each method."""
        self.heading("Figures")
        name_wide, columns = 2.3, 1.25
        self.y -= _line(_SIZE)
        for j, method in enumerate(metrics):
            name = self.cut(self.wrapped(method, columns, _SIZE), 1)[0]
            self._text(_MARGIN + name_wide + j * columns, self.y, name, _SIZE, {"weight": "bold"})
        for key, metric in METRICS.items():
            if not any(key in values for values in metrics.values()):
                continue
            self.y -= _line(_SIZE)
            self._text(_MARGIN, self.y, metric.label, _SIZE, {"color": "0.35"})
            for j, values in enumerate(metrics.values()):
                text = formatted(key, values[key]) if key in values else "–"
                self._text(_MARGIN + name_wide + j * columns, self.y, text, _SIZE, {})
            last = _MARGIN + name_wide + len(metrics) * columns
            self._text(last, self.y, metric.direction, _SMALL, {"color": "0.35"})

    def slices(self, volume: Volume, unit: str, high: float) -> None:
        """Three slices through the bright centre, in a row for each grey window, not higher than this."""
        self.heading("Slices")
        at, grid = bright_centre(volume.data), volume.grid
        data = volume.data
        images = [np.asarray(image, np.float32) for image in (data[at[0]], data[:, at[1]], data[:, :, at[2]])]
        label, gaps = _line(_SMALL, 1.5), 2 * _GAP
        row = (high - _HEADING - _line(_SMALL, 0.5)) / len(_WINDOWS) - 2 * label
        ratios = [max(image.shape[0] / image.shape[1], _THIN) for image in images]
        wide = min((self.wide - gaps) / 3, row / max(ratios))
        if wide < _LEAST:
            self.lines(["No room on this page: see the report."], color="0.35")
            return
        self.y -= _line(_SMALL, 0.5)
        pitch, tallest = max(wide, _CAPTION) + _GAP, wide * max(ratios)
        for low, top, name in _WINDOWS:
            window = grey_window(images, low, top)
            self.y -= label
            self._text(_MARGIN, self.y + 0.04, f"{name}: {window[0]:.3g} to {window[1]:.3g} 1/{unit}", _SMALL, {})
            for j, (image, ratio, (across, down, *edges)) in enumerate(zip(images, ratios, planes(grid), strict=True)):
                left, foot = _MARGIN + j * pitch, self.y - wide * ratio
                size = wide / _PAGE[0], wide * ratio / _PAGE[1]
                axes = self.figure.add_axes((left / _PAGE[0], foot / _PAGE[1], *size))
                axes.imshow(
                    _coarse(image),
                    cmap="gray",
                    aspect="auto",
                    interpolation="nearest",
                    norm=Normalize(*window),
                )
                axes.set(xticks=[], yticks=[])
                sides = " × ".join(f"{abs(last - first):.3g}" for first, last in edges)
                cut = f"{'zyx'[j]} = {grid.coordinates()[j][at[j]]:.3g} {unit}"
                text = f"{cut}, {across} → {down} ↓, {sides} {unit}"
                caption = self.fitting(text, pitch - _GAP)
                self._text(left, foot - 0.7 * label, caption, _SMALL, {"color": "0.35"})
            self.y -= tallest + label

    def fitting(self, text: str, wide: float) -> str:
        """The text, or its beginning up to a comma that fits."""
        while self._width(text, _SMALL, {}) > wide and "," in text:
            text = text[: text.rfind(",")]
        return text

    def cut(self, lines: list[str], most: int) -> list[str]:
        return lines if len(lines) <= most else [*lines[: most - 1], f"{lines[most - 1][:-2]}…"]

    def wrapped(self, text: str, wide: float, size: float, **style: Any) -> list[str]:
        """Lines no wider than this; words that are wider are broken."""
        wide *= 0.98  # a viewer's letters are not of the same width to the last bit
        lines, line, so_far, gap = [], "", 0.0, self._width(" ", size, style)
        for word in str(text).split():
            long = self._width(word, size, style)
            if line and so_far + gap + long > wide:
                lines.append(line)
                line = ""
            while long > wide and len(word) > 1:
                n = max(1, bisect_right(range(1, len(word)), wide, key=partial(self._prefix_width, word, size, style)))
                lines.append(word[:n])
                word = word[n:]
                long = self._width(word, size, style)
            line, so_far = (f"{line} {word}", so_far + gap + long) if line else (word, long)
        return [*lines, line] if line else lines or [""]

    def _prefix_width(self, word: str, size: float, style: Mapping[str, Any], n: int) -> float:
        """Inches of its first n letters."""
        return self._width(word[:n], size, style)

    def _width(self, text: str, size: float, style: Mapping[str, Any]) -> float:
        """Inches."""
        return _text_width(text, size, str(style.get("family", "sans-serif")), str(style.get("weight", "normal")))

    def _text(self, x: float, y: float, text: str, size: float, style: Mapping[str, Any]) -> None:
        self.figure.text(x / _PAGE[0], y / _PAGE[1], text, fontsize=size, parse_math=False, **style)


@lru_cache(10_000)
def _text_width(text: str, size: float, family: str, weight: str) -> float:
    """Inches."""
    font = FontProperties(size=size, family=family, weight=weight)
    width = RendererAgg(1, 1, _FINE).get_text_width_height_descent(text, font, ismath=False)[0]
    return float(width) / _FINE


def _coarse(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means of blocks, so that no side has more pixels than a page shows."""
    n = -(-max(image.shape) // _FINEST)
    if n == 1:
        return image
    rows, cols = (max(1, length // n) for length in image.shape)
    m = min(n, image.shape[0])
    part = image[: rows * m if rows > 1 else m, : cols * n]
    return np.asarray(part.reshape(rows, -1, cols, n).mean(axis=(1, 3)), np.float32)
