"""Files that hold a volume, by format."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class FormatEntry:
    """A registry entry of a format of volume files.

    Attributes:
        suffixes: that a file's name ends in, the usual one first; "" for a folder.
        note: what help says of it.
    """

    module: str
    cls: str
    suffixes: tuple[str, ...]
    note: str = ""
