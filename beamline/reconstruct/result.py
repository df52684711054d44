"""Delivery: a volume becomes a file, figures of merit and a report; either all of them or none."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Sink, VolumeDone
from beamline.core.files import remove
from beamline.core.voxel_kind import VoxelKind
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.judge import VolumeLooks, judge
from beamline.reconstruct.model import arrays_of_model
from beamline.reconstruct.outcome import ReportContext, label_of
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.parameters import parameters_of
from beamline.report.record import history_arrays, price_of_decibel, price_text
from beamline.storage import hdf5
from beamline.storage.recon_record import ReconRecord, VolumeInFile
from beamline.storage.volumes.files import opened_volume, write_volume
from beamline.storage.writers.partial_volume import complete
from drivers.base.clock import Clock
from recon.base.method import Reconstruction
from recon.base.volume import Volume
from recon.methods import BASELINE


def write_result(
    made: Reconstruction,
    prepared: PreparedProjections,
    truth: Volume | None,
    target: OutputPaths,
    context: ReportContext,
    sink: Sink,
    clock: Clock,
    partial_volume: Path | None = None,
) -> dict[str, float]:
    """Judge the volume, write its file and the report, and send the event `done`. Returns the metrics.

    Args:
        partial_volume: the partial volume that becomes the output as it is; None: the volume is written.

    Raises:
        DataError: a result could not be written; none is left where one fails.
    """
    phases = context.phases
    phases.enter("measuring the volume")
    judged = judge(made, prepared, truth, target, context, sink, clock, partial_volume is not None)
    elapsed = clock.now() - context.started
    remarks = [*judged.warnings, *([judged.left_out_text] if judged.left_out_text else [])]
    context = replace(context, warnings=remarks, stray=judged.stray_map, elapsed=elapsed)
    phases.enter("report")
    record, volumes = _record(judged, context, clock.now())
    page: Path | None = None
    try:
        if target.report is not None:
            from beamline.reconstruct.recon_report import compose  # here: matplotlib takes a second
            from beamline.report.html import write_report

            metrics, parameters = judged.metrics, record.parameters
            report = compose(made, prepared, truth, volumes, metrics, parameters, context, judged.unexplained)
            report = replace(report, volume=target.output.name if target.written else "")
            write_report(target.report, report, replace=target.replace)
            page = target.report
        phases.enter("writing the volume")
        target.take(record)
        if partial_volume is not None:
            complete(partial_volume, record, target.output, replace=target.replace)
        elif target.written:
            _write(record, target)
    except BaseException:
        if page is not None:
            remove(page)
        raise
    phases.end()
    elapsed = clock.now() - context.started
    record = replace(record, **_left_in_file(record, target), elapsed=elapsed, times=phases.seconds)
    sink(VolumeDone(record, time=clock.now()))
    return dict(record.metrics)


def _record(judged: VolumeLooks, context: ReportContext, now: float) -> tuple[ReconRecord, dict[str, Volume]]:
    """The record of the volume, and the volumes of the report by method; of a region where one is wanted."""
    made, prepared, target = judged.made, judged.prepared, judged.target

    def written(volume: Volume) -> Volume:
        return prepared.stretched(volume if context.region is None else context.region.cut(volume))

    volumes = {method: written(volume) for method, volume in judged.volumes.items()}
    record = ReconRecord(
        volume=volumes[made.method],
        length_unit=prepared.length_unit,
        kind=VoxelKind.SHARE if made.series is not None and made.series.names else prepared.kind,
        raw_file=str(context.facts.path.resolve()),
        title=_title(made, context),
        sample=context.facts.sample or "not stated",
        time=now,
        parameters=parameters_of(made, prepared, context),
        metrics=judged.metrics[made.method],
        history=history_arrays(made.history),
        model={} if made.gaussians is None else arrays_of_model(made.gaussians, prepared.geometry),
        deviation=None if made.deviation is None else written(made.deviation).data,
        fbp=volumes[BASELINE].data if judged.keeps_fbp else None,
        series=made.series,
        compared=judged.metrics.get(BASELINE) if len(judged.metrics) > 1 else None,
        warnings=tuple(judged.warnings),
        hiding=judged.hiding,
        chosen=context.chosen,
        next_decibel=price_of_decibel(made),
        next_decibel_text=price_text(made),
        output=target.outputs[0],
        outputs=dict(zip(target.names, target.outputs, strict=True)) if target.names else {},
        report=target.report,
    )
    return record, volumes


def _title(made: Reconstruction, context: ReportContext) -> str:
    if made.series is not None:
        what = ", ".join(made.series.names) or f"{made.series.n} volumes in time"
        return f"{what} of {context.facts.name}"
    return f"{label_of(made.method)} reconstruction of {context.facts.name}"


def _write(record: ReconRecord, target: OutputPaths) -> None:
    """All files, or none of them."""
    with ExitStack() as undo:
        for path, each in zip(target.outputs, _in_files(record, target.names), strict=True):
            write_volume(path, each, replace=target.replace)
            undo.callback(remove, path)
        undo.pop_all()


def _in_files(record: ReconRecord, names: Sequence[str]) -> Iterator[ReconRecord]:
    """The record of each file: of one volume where each has a name."""
    if not names or record.series is None:
        yield record
        return
    for name, data in zip(names, record.series.each(), strict=True):
        yield replace(
            record,
            volume=replace(record.volume, data=data[:]),
            series=None,
            title=f"volume fraction of {name}",
            parameters={**record.parameters, "material": name},
        )


def _left_in_file(record: ReconRecord, target: OutputPaths) -> dict[str, Any]:
    """Fields of a record that holds no voxels and no open file until they are used: all are in the file alone."""

    def read() -> Volume:
        with opened_volume(target.outputs[0], at=None if target.names or record.series is None else 0) as stored:
            return replace(stored.volume, data=np.array(stored.volume.data[:]))

    series = record.series
    if series is not None and target.written:
        series = replace(series, data=_VolumesInFiles(target.outputs, series.data.shape))
    return {"volume": VolumeInFile(record.grid, read), "series": series, "deviation": None, "fbp": None, "model": {}}


@dataclass(frozen=True)
class _VolumesInFiles:
    """Volumes [volume, z, y, x] of one file, or of a file each, which are opened where they are used."""

    paths: tuple[Path, ...]
    shape: tuple[int, ...]

    @property
    def dtype(self) -> np.dtype[np.float32]:
        return np.dtype(np.float32)

    def __getitem__(self, part: Any) -> NDArray[np.float32]:
        if len(self.paths) == 1:
            return self._read(self.paths[0], part)
        which, *within = part if isinstance(part, tuple) else (part,)
        numbers = np.arange(self.shape[0])[which]
        if numbers.ndim == 0:
            return self._read(self.paths[numbers], tuple(within))
        return np.stack([self._read(self.paths[n], tuple(within)) for n in numbers])

    @staticmethod
    def _read(path: Path, part: Any) -> NDArray[np.float32]:
        with hdf5.open_hdf5(path) as file, hdf5.readable(path):
            return np.asarray(file["entry/data/data"][part])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> NDArray[Any]:
        return np.asarray(self[:], dtype)
