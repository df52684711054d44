"""Text for people: angles, sizes, numbers of things, ranges of indices."""

from __future__ import annotations

import csv
import io
import math
import re
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


def memory_size(text: str) -> int:
    """Parse a size such as 8G, 500M or 1.5GB (decimal units) to bytes. Raises ValueError for any other text."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([KMGT])B?", text.strip(), re.IGNORECASE)
    if match is None or not float(match[1]) > 0:
        raise ValueError(f"{text!r} is not a size; expected a number and K, M, G or T, such as 8G")
    return round(float(match[1]) * 1000 ** (" KMGT".index(match[2].upper())))


def rounded(value: float, *, up: bool = False) -> float:
    """A positive value rounded down (or up) to three digits, so that a recommended limit is safe. Other values are
    returned unchanged."""
    if not 0 < value < math.inf:
        return value
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return (math.ceil(value / unit - 1e-9) if up else math.floor(value / unit + 1e-9)) * unit


def printable(text: str) -> str:
    """The text for a terminal: control characters become `\\x1b` or `\\t`, except line ends, so that none acts."""
    if text.isprintable():  # cut first, because the text may have 50 MB
        return text
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


SENTENCE = 10_000  # number of characters of the longest text that is shown in one line


def one_line(text: str, most: int = 200) -> str:
    """A text from outside the program as one line for a log or a terminal: shortened, and without control
    characters."""
    line = printable(" ".join(text[: 4 * most].split()))
    return line if len(line) <= most else line[: most - 3] + "..."


_DEVICE = re.compile(r"^(con|prn|aux|nul|com\d|lpt\d) *(\..*)?$", re.IGNORECASE)  # of Windows, in any folder


def safe_name(text: str, most: int = 120) -> str:
    """A safe name for a file or folder, made from a text from outside the program. It cannot lead out of its folder,
    and has no special meaning for any file system, shell, terminal or spreadsheet. If the text is a safe name, it is
    returned unchanged.

    Args:
        most: largest number of bytes; the rest is cut off.
    """
    shown = "".join(c if c.isprintable() else "_" for c in text)
    legal = _DEVICE.sub(r"_\g<0>", re.sub(r'[<>:"/\\|?*$`;]', "_", shown).lstrip(" .-=+@~"))
    return legal.encode()[:most].decode(errors="ignore").rstrip(" .") or "unnamed"


def count(n: int, noun: str) -> str:
    """`1 view`, `2 views`."""
    return f"{n} {noun}" if n == 1 else f"{n} {noun}s"


def spans(indices: Sequence[int], limit: int = 12) -> str:
    """Ascending indices as readable text: `3, 7-9, 12`. If there are more than `limit` groups, the text ends in `... (n
    in all)`."""
    groups: list[tuple[int, int]] = []
    for i in indices:
        if groups and i == groups[-1][1] + 1:
            groups[-1] = (groups[-1][0], i)
        else:
            groups.append((i, i))
    text = ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in groups[:limit])
    return text if len(groups) <= limit else f"{text}, ... ({len(indices)} in all)"


def with_points(numbers: Sequence[str]) -> list[str]:
    """The numbers of a file, as text, with decimal commas replaced by decimal points, if all numbers have decimal
    commas.

    Raises:
        ValueError: the commas may group thousands, or separate numbers.
    """
    commas, points = ([text.strip() for text in numbers if mark in text] for mark in ",.")
    thousands = all(re.fullmatch(r"[-+]?[1-9]\d{0,2},\d{3}", text) for text in commas)
    if commas and (points or thousands or any(text.count(",") > 1 for text in commas)):
        with_point = f" next to {one_line(points[0], 40)} with a point" if points and points[0] != commas[0] else ""
        first_line = one_line(commas[0], 40)
        raise ValueError(
            f"{first_line} has a comma{with_point}, and it is not clear whether this comma separates decimals: write "
            "one number on a line, with a decimal point"
        )
    return [text.replace(",", ".") for text in numbers]


def are_a_count(texts: Sequence[str]) -> bool:
    """Whether texts are consecutive whole numbers, in any order."""
    numbers = {int(text) for text in texts if text.isdecimal()}
    return len(numbers) == len(texts) == max(numbers, default=0) - min(numbers, default=1) + 1


def aligned(rows: Sequence[Sequence[str]], to: str = "<") -> str:
    """Rows of cells as lines with aligned columns; `to`: "<" aligns left, ">" right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(f"{cell:{to}{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows
    )


NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
"""The regular expression of a decimal number without a sign."""
_FORMULA = re.compile(rf"[=@\n]|[+-](?!$|{NUMBER}$|inf$|nan$)", re.IGNORECASE)


def _cell(value: object) -> str:
    return "" if value is None else printable(str(value))


def csv_text(rows: Iterable[Iterable[object]]) -> str:
    """Rows of cells as CSV, one line per row, without control characters; text that a spreadsheet would compute begins
    with `'`."""
    out = io.StringIO()
    csv.writer(out, lineterminator="\r\n").writerows(  # the csv module quotes cells with one of these
        [f"'{text}" if _FORMULA.match(text) else text for text in map(_cell, row)] for row in rows
    )
    return out.getvalue().replace("\r\n", "\n")


def frames_text(frames: Iterable[int]) -> str:
    """Rows of a file as `frame 3` or `frames 3, 7-9`."""
    rows = [int(frame) for frame in frames]
    return f"{'frame' if len(rows) == 1 else 'frames'} {spans(rows)}"
