"""The tables of docs/file_layout.md and the content of files, for tests that compare them."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

import h5py

PAGE = (Path(__file__).parents[3] / "docs" / "file_layout.md").read_text(encoding="utf-8")


def rows(title: str) -> list[list[str]]:
    """Cells of the tables in a section of the page without the headings; one row for each name in the first cell."""
    section = re.split(r"^#+ ", PAGE, flags=re.M)
    (text,) = [part for part in section if part.startswith(f"{title}\n")]
    lines = [line for line in text.splitlines() if line.startswith("| ")][1:]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    return [[name, *others] for first, *others in cells for name in first.split(", ")]


def names(title: str) -> list[str]:
    return [row[0].strip("` ") for row in rows(title)]


def unmatched(found: Iterable[str], named: Iterable[str]) -> tuple[set[str], set[str]]:
    """Names that were found but are not on the page, and names on the page that were not found."""
    found, pattern = set(found), {}
    for name in named:
        pattern[name] = re.compile(re.sub(r"<[^>]*>", "[^/]+", re.escape(name).replace(r"\ ", " ")) + r"\Z")
    return (
        {path for path in found if not any(p.match(path) for p in pattern.values())},
        {name for name, p in pattern.items() if not any(p.match(path) for path in found)},
    )


def paths(*files: Path) -> set[str]:
    """The paths of all datasets in HDF5 files, including links."""
    found: set[str] = set()

    def walk(group: h5py.Group) -> None:
        for name, item in group.items():
            if isinstance(item, h5py.Group):
                walk(item)
            else:
                found.add(f"{group.name.rstrip('/')}/{name}")

    for path in files:
        with h5py.File(path) as file:
            walk(file)
    return found
