"""ingest: copies a scan of any format, frame by frame, into a file of this program, with statistics of each frame.

Integer frames become an NXtomo. Float frames (such as float32 stacks) cannot become an NXtomo, because data of an
NXtomo are integers, and rounding would lose information. Float frames keep their type and have the same paths in the
file. The definition of their file is `splatline_float_projections`, so that no program mistakes them for counts.
open_scan reads both kinds of files.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beamline.core.errors import DataError
from beamline.core.events import json_of
from beamline.core.files import atomic_file
from beamline.monitor.digest import digest
from beamline.storage import hdf5
from beamline.storage.flag_legend import UNMARKED
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.open import SourceOptions, open_scan
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import altered_sentence, parts_joined, stated_used
from beamline.storage.writer_lock import QUIET, held
from beamline.storage.writers import layout
from beamline.storage.writers.rows import DIED, PER_FLUSH, RUNNING, Rows, ScanEnding, complete


@dataclass(frozen=True)
class Ingested:
    """The written copy. `definition`: NXtomo, or float projections. `invalid_frames`: number of frames without a valid
    pixel.

    `doubts`: values in the input that may change the volume, but are neither used nor stored in the copy.
    """

    path: Path
    definition: str
    frames: int
    pixel_bytes: int
    invalid_frames: int
    doubts: tuple[str, ...] = ()


def ingest(
    scan: SourceOptions | Path | str,
    out: Path | str,
    *,
    pixel_size_mm: float | None = None,
    energy_kev: float | None = None,
    sample: str | None = None,
    no_data: float | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Ingested:
    """Copy a scan into the new file `out`. Only one frame at a time is in memory.

    Args:
        pixel_size_mm, energy_kev, sample: values to store if the input does not state them.
        no_data: value of pixels without data; such pixels count as invalid in the statistics. progress: function called
            after each frame with the number of frames written and of all frames.

    Raises:
        DataError: the input cannot be read, `out` exists, or the disk fails. No incomplete file remains.
    """
    out = Path(out)
    with atomic_file(out) as partial, open_scan(scan) as source:
        ending = _ending_of(source)
        _refuse_what_a_copy_would_not_state(source)
        distance = source.attributes.get("distance_mm")
        other_angles = isinstance(scan, SourceOptions) and (scan.angles is not None or scan.angles_path is not None)
        if source.cone is not None:
            distance = source.cone[1] - source.cone[0]
        info = layout.ScanInfo(
            sample=sample or str(source.attributes.get("sample", source.path.stem)),
            title=f"ingested from {source.path.name}",
            pixel_size_mm=pixel_size_mm or source.pixel_size_mm,
            energy_kev=energy_kev or source.energy_kev,
            axis_col=source.axis_col,
            distance_mm=distance if isinstance(distance, int | float) else None,
            source_distance_mm=None if source.cone is None else source.cone[0],
            plan=json_of({} if other_angles else dict(source.plan)),
            offset_views=source.table.aside is not None,
            decides=source.table.pass_ends.size > 0,
        )
        with hdf5.created(partial, layout.LIBVER) as file:
            invalid = _copy(source, file, out, info, no_data, progress)
            complete(file, ending)
        definition = layout.NXTOMO if source.dtype.kind in "iu" else layout.FLOAT_DEFINITION
        frames = len(source.table)
        size = frames * source.shape[0] * source.shape[1] * source.dtype.itemsize
        stated = ScanEvidence(source)
        findings = (*parts_joined(stated), *(each for each in stated_used(stated) if each.severity != "info"))
        return Ingested(out, definition, frames, size, invalid, tuple(finding.message for finding in findings))


def _refuse_what_a_copy_would_not_state(source: ScanSource) -> None:
    """Raise DataError for a scan with unknown angles, displaced projections, altered rows or oblong pixels, which the
    copy could not store."""
    n = source.table.views.size
    if n_unknown := n - source.table.views_with_angles.size:
        raise DataError(
            f"{source.path} does not state the angles of {n_unknown} of its {n} projections. Add --angles FILE "
            "(degrees, one a line). Nothing was written."
        )
    if source.table.shifts is not None:
        raise DataError(
            f"{source.path} states a shift for each projection, but the copy cannot store these shifts. "
            "Reconstruct the original file instead. Nothing was written."
        )
    if source.table.altered.any():
        raise DataError(f"{altered_sentence(source)} Nothing was written.")
    if source.row_pitch_mm is not None:
        raise DataError(
            f"{source.path} has pixels of {source.pixel_size_mm} x {source.row_pitch_mm:g} mm, but the copy can state "
            "only one pixel size. Reconstruct the original file instead. Nothing was written."
        )


def _copy(
    source: ScanSource,
    file: hdf5.NewFile,
    out: Path,
    info: layout.ScanInfo,
    no_data: float | None,
    progress: Callable[[int, int], None] | None,
) -> int:
    dtype = source.dtype.newbyteorder("<")
    layout.create(file, info, source.shape, dtype, quantity=source.quantity, preview_bin=4, start=None)
    if no_data is not None:
        file["/entry/record/no_data"] = float(no_data)
    if source.table.part_starts.size > 1:
        file[layout.PART_STARTS] = source.table.part_starts
    if info.decides:
        lines = [json_of(values).encode() for values in source.decisions]
        for path, column in ((layout.PASS_ENDS, source.table.pass_ends), (layout.DECISIONS, lines)):
            file[path].resize(len(column), 0)
            file[path][...] = np.array(column, file[path].dtype)
    rows = Rows(file)
    saturation = np.iinfo(dtype).max if dtype.kind in "iu" else None
    table, invalid = source.table, 0
    for i in range(len(table)):
        try:
            image = source.read([i])[0].astype(dtype, copy=False)
        except hdf5.UnreadableError as error:
            raise DataError(f"{error} Nothing is left of {out}.") from error
        if i in source.damaged:
            raise DataError(
                f"Frame {i} of {source.path} is damaged: its pixels differ from the stored checksum. Use an intact "
                f"copy of the file; `beamline validate --deep` checks all frames. {out} was not written."
            )
        statistics = digest(image, saturation=saturation, no_data=no_data)
        invalid += statistics.invalid_fraction == 1.0
        frame = replace(table.frame(i, image), replaces=-1)
        rows.write(frame, statistics, UNMARKED if table.flags is None else table.flags.mark(i))
        file.require_taken()
        if progress is not None:
            progress(i + 1, len(table))
        if (i + 1) % PER_FLUSH == 0:
            rows.flush()
    rows.flush()
    return invalid


def _ending_of(source: ScanSource) -> ScanEnding:
    """How the scan ended. Raises DataError if the scan is still running, because it is not known yet which frames will
    be missing."""
    if source.ending.status != RUNNING:
        return source.ending
    if held(source.path) or time.time() - source.path.stat().st_mtime < QUIET:
        raise DataError(
            f"{source.path} is still being written, or the program that wrote it was killed less than {QUIET:.0f} s "
            "ago. Wait until the scan has ended. Nothing was written."
        )
    return replace(source.ending, status="failed", reason=DIED)
