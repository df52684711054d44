"""Scan facts: facts about a scan for the report, and the context of a reconstruction."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import Phases
from beamline.core.text import frames_text
from beamline.plan.passes import ended_by
from beamline.projections.prepared import PreparedProjections
from beamline.projections.selection import Selection
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.region import RegionOfRows
from beamline.storage.flag_legend import FrameFlags, counted
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules.scan import scan_ended
from drivers.base.frame import FrameKind
from recon.base.method import Reconstruction
from recon.base.volume import Volume
from recon.methods import by_name
from recon.voxels.fbp import Filter

if TYPE_CHECKING:
    from beamline.report.sheets import FlaggedFrame

from itertools import zip_longest
from typing import TYPE_CHECKING

from beamline.monitor.check import Level
from beamline.storage.flag_legend import FlagBit
from beamline.storage.rules.evidence import ScanEvidence, groups_of
from recon.base.arrays import bin_views

if TYPE_CHECKING:
    from beamline.report.sheets import FlaggedFrame

MOST = 12
APART = 3  # shortest distance, in frames, between two shown frames of the same check, because neighbours look similar
PIXELS = 200  # approximate side of a picture


def reasons(flags: FrameFlags) -> list[str]:
    """One line for each check and level, alarms first. A line states the frames, the worst score and the meaning."""
    lines = []
    for level in (Level.ALARM, Level.WARN):
        for i, entry in enumerate(flags.legend):
            rows = flags.rows(entry, level)
            if not rows.size:
                continue
            worst = ""
            scored = rows[np.isfinite(flags.scores[rows, i])]
            if scored.size:
                worst_row = scored[np.argmax(np.abs(flags.scores[scored, i]))]
                worst = f", worst {flags.scores[worst_row, i]:.3g} {entry.unit} in frame {worst_row}"
            name = f"{str(level).capitalize()} ({entry.name})"
            lines.append(f"{name}: {frames_text(rows)}{worst}: {entry.meaning}.")
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
    """Binned pictures by title: the mean dark, the means of the first and the last group of flats, and the ratio of
    these two means. At most four frames of a group are read. The result is empty if the pixels of the scan are not
    counts.
    """
    if source.quantity != "counts":
        return {}
    darks, flats = (groups_of(source.table, kind) for kind in (FrameKind.DARK, FrameKind.FLAT))
    shown = {"dark": darks[:1], "flats": flats[:1], "last flats": flats[1:][-1:]}
    images = {}
    for title, groups in shown.items():
        for group in groups:
            mean = np.mean([_small(source.read([row])[0]) for row in group[:4]], axis=0, dtype=np.float32)
            images[f"{title} (counts)"] = np.asarray(mean, np.float32)
    if len(images) == len(shown):
        dark, first, last = images.values()
        exposed = first - dark > 0.1 * np.median(first - dark)
        images["last flats / first"] = np.where(exposed, (last - dark) / np.where(exposed, first - dark, 1), np.nan)
    return images


def _ranked(flags: FrameFlags, check: int, entry: FlagBit, level: Level) -> list[int]:
    rows = flags.rows(entry, level)
    rows = rows[np.argsort(-np.abs(flags.scores[rows, check]), kind="stable")]
    ranked: list[int] = []
    for row in rows.tolist():
        if all(abs(row - shown_row) >= APART for shown_row in ranked):
            ranked.append(row)
    return ranked[:MOST]


def _frame(source: ScanSource, flags: FrameFlags, row: int) -> FlaggedFrame:
    from beamline.report.sheets import FlaggedFrame  # imported here, because it loads matplotlib

    angle = float(np.degrees(source.table.angles[row]))
    kind, replaces = source.table.kind(row).name.lower(), source.table.replaces
    if replaces is not None and (new := np.flatnonzero(replaces == row)).size:
        kind = f"replaced by {new[0]}"
    labels, regions, colour = [], [], "tab:orange"
    for i, entry in enumerate(flags.legend):
        if not flags.bits[row] >> entry.bit & 1:
            continue
        is_alarm = bool(flags.bits[row] >> entry.alarm_bit & 1)
        colour = "tab:red" if is_alarm else colour
        score = f" {flags.scores[row, i]:.3g}" if np.isfinite(flags.scores[row, i]) else ""
        labels.append(f"{entry.name} {Level.ALARM if is_alarm else Level.WARN}{score}")
        if flags.regions[row, i, 0] >= 0:
            top, bottom, left, right = flags.regions[row, i].tolist()
            regions.append((top, bottom, left, right))
    title = f"frame {row}, {kind}" + (f", {angle:.1f}°" if np.isfinite(angle) else "")
    return FlaggedFrame(
        _small(source.read([row])[0]), source.shape, title, labels, [(region, colour) for region in regions], colour
    )


def _small(image: NDArray[np.generic]) -> NDArray[np.float32]:
    """The image, binned until it has about `PIXELS` pixels a side. Rows and columns that do not fill a bin are
    dropped.
    """
    factor = max(1, min(image.shape[1] // PIXELS, *image.shape))
    return np.asarray(bin_views(np.nan_to_num(image.astype(np.float32))[None], factor)[0])


@dataclass(frozen=True)
class ScanFacts:
    """The facts of a scan for a report.

    Attributes:
        table: facts for people, by name.
        frames: number of frames in the file and number of planned frames, e.g. "110/110".
        remarks: faults during the scan, as the file states them.
        flagged: the worst of the flagged frames.
        references: binned mean darks and flats [row, col], by title.
        shape: rows and columns of a frame.
        columns: used columns of the detector, in the form of --cols (the last column is not included); empty: all
            columns.
        ended: how and why the scan ended before it took all its frames; empty: the scan took all frames or is still
            running.
        frames_per_view: number of frames that are averaged to one projection.
        live_picture: file name of the last picture of a live volume; empty: there was no live volume.
    """

    path: Path
    name: str
    sample: str
    table: Mapping[str, str]
    frames: str
    remarks: Sequence[str] = ()
    flagged: Sequence[FlaggedFrame] = ()
    references: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    shape: tuple[int, int] = (1, 1)
    columns: str = ""
    ended: str = ""
    frames_per_view: int = 1
    live_picture: str = ""


@dataclass(frozen=True)
class ReportContext:
    """The context of a reconstruction: the scan, the selection, the command, and the warnings so far.

    Attributes:
        filter: filter of FBP, also of the FBP with which the volume is compared.
        leaves: function that returns True if this number of seconds is left before the report.
    """

    facts: ScanFacts
    selection: Selection
    command: str
    seed: int
    warnings: Sequence[str] = ()
    started: float = 0.0
    recipe: str = ""
    region: RegionOfRows | None = None
    phases: Phases = field(default_factory=Phases)
    leaves: Callable[[float], bool] = lambda seconds: True
    filter: Filter = "hann"


@dataclass(frozen=True, eq=False)
class MadeVolume:
    """A volume, with everything that is needed to check it, to write its record and to make its report.

    Attributes:
        result: the volume, and what the method states about it.
        prepared: the projections from which the volume was made, and their origin.
        truth: the ground truth on the grid of the volume; None: there is no ground truth.
        target: the files to write.
        context: the context of the reconstruction.
    """

    result: Reconstruction
    prepared: PreparedProjections
    truth: Volume | None
    target: OutputPaths
    context: ReportContext


def label_of(method: str) -> str:
    """The name of a method for people."""
    return by_name(method).label


def facts_of(source: ScanSource, flags: FrameFlags | None = None) -> ScanFacts:
    """The facts of an open scan. If `flags` are given, they replace those of the file."""
    attributes = dict(source.attributes)
    sample = str(attributes.pop("sample", attributes.pop("sample_name", "")))
    columns = "" if source.cols is None else f"{source.cols[0]}:{source.cols[1]}"
    missing, flags = int(attributes.get("missing_triggers", 0)), source.table.flags if flags is None else flags
    table = _table(source, sample or "not stated", columns)
    table["flagged by the monitor"] = "not checked by the monitor" if flags is None else counted(flags.counts())
    table |= {str(k): as_text(v) for k, v in attributes.items() if len(str(v)) <= 200 and str(k) not in table}
    n, replaced = len(source.table), source.table.replaced
    if replaced.size:
        table["views taken again"] = f"{replaced.size}, because of an alarm; not used: {frames_text(replaced)}"
    dropped = sum(int(decision.get("dropped") or 0) for decision in source.decisions)
    remarks = [*filter(None, [ended_by(source.decisions)]), *([] if flags is None else reasons(flags))]
    return ScanFacts(
        source.path, source.path.name, sample, table, f"{n}/{n + missing + dropped}", remarks,
        flagged=[] if flags is None else worst_frames(source, flags),
        references=reference_images(source),
        shape=source.shape,
        columns=columns,
        ended=" ".join(finding.message for finding in scan_ended(ScanEvidence(source))) if source.finished else "",
        frames_per_view=source.frames_per_view,
    )  # fmt: skip


def _table(source: ScanSource, sample: str, columns: str) -> dict[str, str]:
    """What the reader knows about a scan, as texts for people, by name."""
    counts = {kind: source.table.of_kind(kind).size for kind in FrameKind}
    pitch, energy = source.pixel_size_mm, source.energy_kev
    return {
        "file": source.path.name,
        "format": source.format,
        "sample": sample,
        "projections": str(counts[FrameKind.PROJECTION]),
        "flats, darks": f"{counts[FrameKind.FLAT]}, {counts[FrameKind.DARK]}",
        "detector (rows × columns)": f"{source.shape[0]} × {source.shape[1]}"
        + (f", columns {columns}" if columns else ""),
        "pixel size": "not known" if pitch is None else f"{pitch * 1e3:.4g} µm",
        "energy": "not known" if energy is None else f"{energy:g} keV",
        "axis in the file": "not stated" if source.axis_col is None else f"column {source.axis_col:.2f}",
    }


def as_text(value: object) -> str:
    """A value as text for people; the file has the exact value."""
    if isinstance(value, bool | np.bool_):
        return "yes" if value else "no"
    return f"{value:.6g}" if isinstance(value, float | np.floating) else str(value)
