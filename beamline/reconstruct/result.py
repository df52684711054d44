"""Delivery: a volume becomes a file, figures of merit and a report; either all of them or none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

from beamline.core.events import Sink, VolumeDone
from beamline.core.files import remove
from beamline.projections.prepared import PreparedProjections
from beamline.reconstruct.judge import judge
from beamline.reconstruct.model import arrays_of_model
from beamline.reconstruct.outcome import ReconOutcome, ReportContext, label_of
from beamline.reconstruct.output_paths import OutputPaths
from beamline.reconstruct.parameters import parameters_of
from beamline.report.record import history_arrays
from beamline.storage.volumes.files import write_volume
from beamline.storage.writers.partial_volume import complete
from beamline.storage.writers.recon_file import ReconRecord
from drivers.base.clock import Clock
from recon.base.volume import Volume
from recon.methods import BASELINE

_ENDS = ("ended_early", "resumed_from", "checkpoint_lost")  # settings of an outcome that its event tells


def write_result(
    made: ReconOutcome,
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
    context = replace(context, warnings=judged.remarks, stray=judged.stray, elapsed=elapsed)
    own = judged.metrics[made.method]
    phases.enter("report")
    parameters = parameters_of(made, prepared, context)
    volumes, deviation = judged.volumes, made.deviation
    if (region := context.region) is not None:
        volumes = {method: region.cut(volume) for method, volume in volumes.items()}
        deviation = None if deviation is None else region.cut(deviation)
    volumes = {method: prepared.stretched(volume) for method, volume in volumes.items()}
    deviation = None if deviation is None else prepared.stretched(deviation)
    record = ReconRecord(
        volume=volumes[made.method],
        length_unit=prepared.length_unit,
        kind=prepared.kind,
        raw_file=str(context.facts.path.resolve()),
        title=f"{label_of(made.method)} reconstruction of {context.facts.name}",
        sample=context.facts.sample or "not stated",
        time=clock.now(),
        parameters=parameters,
        metrics=own,
        history=history_arrays(made.history),
        model={} if made.gaussians is None else arrays_of_model(made.gaussians, prepared.geometry),
        deviation=None if deviation is None else deviation.data,
        fbp=volumes[BASELINE].data if judged.keeps_fbp else None,
    )
    page: Path | None = None
    try:
        if target.report is not None:
            from beamline.reconstruct.recon_report import compose  # here: matplotlib takes a second
            from beamline.report.html import write_report

            report = compose(made, prepared, truth, volumes, judged.metrics, parameters, context, judged.left)
            report = replace(report, volume=target.output.name if target.written else "")
            write_report(target.report, report, replace=target.replace)
            page = target.report
        phases.enter("writing the volume")
        target.take(record)
        if partial_volume is not None:
            complete(partial_volume, record, target.output, replace=target.replace)
        elif target.written:
            write_volume(target.output, record, replace=target.replace)
    except BaseException:
        if page is not None:
            remove(page)
        raise
    phases.end()
    said: dict[str, Any] = {name: made.settings[name] for name in _ENDS if name in made.settings}
    sink(
        VolumeDone(
            output=target.output,
            report=target.report,
            method=made.method,
            axis_col=prepared.axis_col,
            n_views=prepared.geometry.n_views,
            shape=record.volume.grid.shape,
            units=record.unit,
            elapsed=clock.now() - context.started,
            times=phases.seconds,
            metrics=own,
            **said,
            hiding=judged.hiding or None,
            chosen=made.chosen or None,
            next_db=made.next_decibel,
            next_db_said=None if made.next_decibel is None else made.next_decibel_text,
            fbp=judged.metrics[BASELINE] if len(judged.metrics) > 1 else None,
            time=clock.now(),
        )
    )
    return own
