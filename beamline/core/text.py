"""Text for people: angles, sizes, numbers of things, index ranges."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Sequence


def degrees(angle: float) -> str:
    return f"{math.degrees(angle):.6g}°"


def size(n_bytes: float) -> str:
    """A number of bytes as text in decimal units, with three digits."""
    for unit in ("B", "kB", "MB", "GB"):
        if n_bytes < 999.5:
            return f"{n_bytes:.3g} {unit}"
        n_bytes /= 1000
    return f"{n_bytes:.3g} TB"


def rounded(value: float, *, up: bool = False) -> float:
    """A positive value rounded down (or up) to three digits, so that an advised limit holds; other values unchanged."""
    if not 0 < value < math.inf:
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return (math.ceil(value / unit - 1e-9) if up else math.floor(value / unit + 1e-9)) * unit


def printable(text: str) -> str:
    """The text for a terminal: control characters become `\\x1b`, except line ends and tabs, so that none acts."""
    if text.isprintable():  # also where it has 50 MB
        return text
    return "".join(c if c.isprintable() or c in "\n\t" else c.encode("unicode_escape").decode() for c in text)


def one_line(text: str, most: int = 200) -> str:
    """A foreign text as one line for a log or a terminal: shortened, without control characters."""
    line = printable(" ".join(text[: 4 * most].split()))
    return line if len(line) <= most else line[: most - 3] + "..."


def count(n: int, noun: str) -> str:
    """`1 view`, `2 views`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def spans(indices: Sequence[int], limit: int = 12) -> str:
    """Ascending indices as readable text: `3, 7-9, 12`; more than `limit` groups end in `... (n in all)`."""
    groups: list[tuple[int, int]] = []
    for i in indices:
        if groups and i == groups[-1][1] + 1:
            groups[-1] = (groups[-1][0], i)
        else:
            groups.append((i, i))
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in groups[:limit])
    return text if len(groups) <= limit else f"{text}, ... ({len(indices)} in all)"


def aligned(rows: Sequence[Sequence[str]], to: str = "<") -> str:
    """Rows of cells as lines with aligned columns; `to`: "<" aligns left, ">" right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{cell:{to}{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as CSV, one line per row."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerows(rows)
    return out.getvalue()


def frames_text(frames: Iterable[int]) -> str:
    """Rows of a file as `frame 3` or `frames 3, 7`."""
    numbers = [str(int(frame)) for frame in frames]
    return ("frame " if len(numbers) == 1 else "frames ") + ", ".join(numbers)
