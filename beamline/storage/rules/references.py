"""Darks and flats of a file: their groups, the good groups, and findings on the others."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from beamline.core.text import spans
from beamline.monitor.digest import block_means, check_block, digest
from beamline.monitor.references import JudgedGroup, ReferenceFrame, ReferenceLimits, full_scale, judge
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.finding import Finding
from drivers.base.frame import FrameKind

SAMPLES = 4  # frames of a group, and views, that are looked at

Frames = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class ReferenceGroups:
    """Darks and flats of a scan, by groups.

    Attributes:
        darks, flats: rows of each group, in the order of the file.
        judged: the verdict on each group, the darks first.
    """

    darks: tuple[Frames, ...]
    flats: tuple[Frames, ...]
    judged: tuple[JudgedGroup, ...]

    def good(self) -> ReferenceGroups:
        """The groups without a fault; for a kind without a good group, all groups."""
        ok = [not group.faults for group in self.judged]
        dark_ok, flat_ok = ok[: len(self.darks)], ok[len(self.darks) :]
        return ReferenceGroups(_kept(self.darks, dark_ok), _kept(self.flats, flat_ok), self.judged)

    def lacking(self) -> tuple[JudgedGroup, ...]:
        """The groups of a kind where all are bad."""
        return tuple(
            group for group in self.judged if all(other.faults for other in self.judged if other.kind is group.kind)
        )


def _kept(groups: tuple[Frames, ...], ok: list[bool]) -> tuple[Frames, ...]:
    return tuple(group for group, good in zip(groups, ok, strict=True) if good) if any(ok) else groups


def groups_of(source: ScanSource, kind: FrameKind) -> tuple[Frames, ...]:
    """Rows of the references of a kind, by groups: those of one part with no projection between them were taken
    together."""
    rows = np.flatnonzero(source.image_key == kind)
    before = np.cumsum(source.image_key == FrameKind.PROJECTION)[rows]
    before += np.searchsorted(source.part_starts, rows, "right")  # neither decreases, so that the sum tells both
    return tuple(np.split(rows, np.flatnonzero(np.diff(before)) + 1)) if rows.size else ()


def reference_groups(source: ScanSource, limits: ReferenceLimits | None = None) -> ReferenceGroups:
    """The references of a scan of counts, judged by a few frames of each group; flats beside those of their part."""
    darks, flats = (groups_of(source, kind) for kind in (FrameKind.DARK, FrameKind.FLAT))
    dark, lit = ([[_reference(source, int(row)) for row in _some(group)] for group in of] for of in (darks, flats))
    views = np.flatnonzero((source.image_key == FrameKind.PROJECTION) & (source.exposures > 0))
    found = judge([*dark, *lit], limits)[: len(darks)]
    for start, end in pairwise([*source.part_starts.tolist(), source.image_key.size]):
        own, seen = [group for group in lit if start <= group[0].row < end], views[(views >= start) & (views < end)]
        witnesses = [_reference(source, int(row)) for row in _some(seen)] if seen.size and own else []
        found += judge([*dark, *own], limits, witnesses)[len(darks) :]
    whole = [JudgedGroup(j.kind, tuple(g.tolist()), j.faults) for j, g in zip(found, (*darks, *flats), strict=True)]
    return ReferenceGroups(darks, flats, tuple(whole))


def references_usable(source: ScanSource, accepted: bool = False) -> Iterator[Finding]:
    """Flats that are lit, whole and even, and darks that are dark; a bad group beside a good one is left out.

    An error where all groups of a kind are bad, a warning for others that have a fault.

    Args:
        accepted: all are used as they are, so that a fault is a warning.
    """
    if source.quantity != "counts":
        return
    groups = reference_groups(source)
    lacking = groups.lacking()
    alike: dict[tuple[FrameKind, tuple[str, ...], bool], list[int]] = {}
    for group in groups.judged:
        if group.faults:
            faults = tuple(fault.message for fault in group.faults)
            alike.setdefault((group.kind, faults, group in lacking), []).extend(group.rows)
    for (kind, faults, none_good), rows in alike.items():
        name = f"{kind.name.lower()}s"
        message = f"The {name} {spans(rows)}: {' '.join(faults)}"
        if accepted:
            yield Finding("warning", "bad-references", f"--references accept: {message}")
        elif none_good:
            message += (
                f" It must not be reconstructed: take new {name}, or give others with --{name}; `beamline recon "
                "--references accept` uses these as they are."
            )
            yield Finding("error", "bad-references", message)
        else:
            yield Finding("warning", "bad-references", f"{message} The other {name} are used instead.")


def _some(group: Frames) -> Frames:
    return group[np.unique(np.linspace(0, group.size - 1, SAMPLES).astype(int))]


def _reference(source: ScanSource, row: int) -> ReferenceFrame:
    image = source.read([row])[0]
    saturation = full_scale(float(image.max())) if image.dtype.kind in "ui" else None
    about = row, FrameKind(int(source.image_key[row])), float(source.exposures[row])
    block = check_block(image.shape)
    if image.dtype == np.uint16:
        saturated = 0.0 if saturation is None else float(np.mean(image >= saturation))
        return ReferenceFrame.seen(*about, saturated, block_means(image, block), block)
    return ReferenceFrame.of(*about, digest(image, saturation, block), block)
