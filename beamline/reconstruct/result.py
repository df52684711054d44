"""Delivery: a volume becomes a file, figures of merit and a report; either all of them or none."""

from __future__ import annotations

import math
import re
import shutil
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.errors import DataError
from beamline.core.events import Sink, StateEntered, VolumeDone, Warned
from beamline.core.files import refuse_existing, remove
from beamline.core.text import size
from beamline.projections.prepared import PreparedProjections
from beamline.projections.steps.registry import recorded
from beamline.reconstruct.measure import measure, regions, residual_share
from beamline.reconstruct.model import arrays_of_model
from beamline.reconstruct.recon_report import ReconOutcome, ReportContext, compose, label_of
from beamline.reconstruct.remarks import (
    hiding_warning,
    lost_mass_warning,
    needles_warning,
    odd_views_warning,
    stray_mass_warning,
)
from beamline.report.html import write_report
from beamline.report.record import history_arrays
from beamline.storage.scratch import scratch_array
from beamline.storage.volumes.files import write_volume
from beamline.storage.writers.partial_volume import complete
from beamline.storage.writers.recon_file import SUFFIXES as RECON_SUFFIXES
from beamline.storage.writers.recon_file import ReconRecord, Value
from drivers.base.clock import Clock
from recon.assess.lost_mass import compare
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE, by_name
from recon.prep.align import AxisEstimate
from recon.voxels.direct import direct, has_direct_method
from recon.voxels.stray_mass import stray_mass, stray_mass_share
from recon.voxels.unexplained import unexplained

_ROOM = 3.0  # times a volume: free disk from which on a second one is kept
_ENDS = ("ended_early", "resumed_from", "checkpoint_lost")  # settings of an outcome that its event tells
# Times of projecting all views that these take, about: a look for odd views, and a direct method with its figures.
_ODD_VIEWS, _DIRECT = 1.5, 2.5


def report_beside(output: Path) -> Path:
    """The page of an output: report.html beside a run's recon.h5, else the output's own name with .html."""
    return output.with_name("report.html") if output.stem == "recon" else output.with_suffix(".html")


@dataclass(frozen=True)
class OutputPaths:
    """Where results go. `report` is None where none is wanted; `replace` takes the place of older results. `take` gets
    the result before the file `output` is written. Where that is not to be `written`, its folder is only worked in."""

    output: Path
    report: Path | None
    replace: bool = False
    take: Callable[[ReconRecord], None] = lambda record: None
    written: bool = True

    @property
    def partial(self) -> Path:
        """The file of a volume in slabs, while it is made."""
        return self.output.with_name(f"{self.output.stem}.partial.h5")

    @property
    def live_picture(self) -> Path:
        """The picture of a volume that grows with its scan."""
        return self.output.with_name(f"{self.output.stem}.live.png")

    def refuse_partial(self) -> None:
        """Raise DataError if there are slabs of an earlier call."""
        if self.partial.exists():
            raise DataError(
                f"{self.partial} exists: it keeps the slabs of a call that was stopped. Go on from it with --resume "
                f"{self.partial}, or move it away. Nothing was touched."
            )

    def refuse_existing(self) -> None:
        """Raise DataError before any work if a result exists, or its folder cannot be written to."""
        if not self.replace:
            for path in (self.output, self.report):
                if path is not None:
                    refuse_existing(path)
        try:
            with tempfile.TemporaryFile(dir=self.output.parent):
                pass
        except OSError as error:
            raise DataError(
                f"{self.output.parent} cannot be written to ({error.strerror or error}). Name an output elsewhere with "
                "-o. Nothing was read."
            ) from error

    def takes_a_second(self, grid: Grid) -> bool:
        """The output is a file of ours, and its disk has room for a second volume of this size."""
        room = shutil.disk_usage(self.output.parent).free > _ROOM * 4 * math.prod(grid.shape)
        return self.written and room and self.output.suffix.lower() in RECON_SUFFIXES

    def require_room(self, n_bytes: int, meanwhile: int = 0) -> None:
        """Raise DataError before the work if the disk has no room for a volume of so many bytes and temporary files of
        `meanwhile` bytes."""
        free = shutil.disk_usage(self.output.parent).free
        if n_bytes + meanwhile > free:
            work = f" and {size(meanwhile)} while it is made" if meanwhile else ""
            raise DataError(
                f"The volume takes {size(n_bytes)}{work}, the disk of {self.output} has {size(free)} free. Free some "
                "space, name an output elsewhere with -o, or give --bin. Nothing was written."
            )


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
    """Measure the volume, write its file and the report, and send the event `done`. Returns the metrics.

    Args:
        partial_volume: the partial volume that becomes the output as it is; None: the volume is written.

    Raises:
        DataError: a result could not be written; none is left where one fails.
    """
    region, phases = context.region, context.phases
    phases.enter("measuring the volume")
    region_only = region is not None and made.volume.grid.shape != Grid.matching(prepared.geometry).shape

    def judged(volume: Volume, seconds: float) -> dict[str, float]:
        found = measure(volume, None if region_only else prepared, truth, mask, phases.progress)
        return {**found, "seconds": seconds}

    left = unexplained(
        made.volume, prepared.projections.data, prepared.geometry, np.random.default_rng(context.seed),
        prepared.ray_factors(),
    )  # fmt: skip
    mask = regions(truth or made.volume, context.seed)  # after the work that takes most memory
    before = clock.now()
    metrics = {made.method: judged(made.volume, made.seconds)}
    all_rays = (clock.now() - before) / residual_share(prepared.geometry, made.volume.grid, prepared.held_out)
    waited_for, direct_method = "ended_early" in made.settings, by_name(made.method).traits.direct
    left_out = []
    remarks, hiding, doubtful = list(context.warnings), "", False

    def warn(said: str) -> None:
        if said:
            sink(Warned(said, time=clock.now()))
            remarks.append(said)

    if left is not None:
        metrics[made.method]["unexplained"] = left.share
        warn(hiding := hiding_warning(made, left))
        doubtful = bool(hiding)
    if waited_for or not context.leaves(stray_mass_share(prepared.geometry, made.volume.grid) * all_rays):
        left_out.append("the look for mass where views show nothing")
    else:
        stray = stray_mass(made.volume, prepared.projections.data, prepared.geometry, prepared.ray_factors())
        if stray is not None:
            metrics[made.method]["stray"] = stray.share
            warn(stray_mass_warning(made, stray))
            context = replace(context, stray=stray.map if stray.share > 0 else None)
    warn(needles_warning(made, prepared.geometry))
    if not (direct_method or waited_for or context.leaves(_ODD_VIEWS * all_rays)):
        left_out.append("the look for views that do not fit the volume")
    else:
        warn(odd_views_warning(made, prepared, context.selection, phases.progress))
    volumes = {made.method: made.volume}
    compared = not direct_method and target.report is not None and has_direct_method(prepared.geometry)
    if compared and (waited_for or not context.leaves(_DIRECT * all_rays)):
        left_out.append("FBP for comparison")
    elif compared:
        phases.enter("FBP for comparison", "slices")
        before = clock.now()
        grid, out = made.volume.grid, None
        if isinstance(made.volume.data, np.memmap):
            out = scratch_array(target.output.parent, grid.shape)
        data = direct(prepared.projections.data, prepared.geometry, grid, made.filter, phases.progress, out)
        volumes = {BASELINE: Volume(data, made.volume.grid), **volumes}
        metrics = {BASELINE: judged(volumes[BASELINE], clock.now() - before), **metrics}
    if BASELINE in volumes:  # it is the first
        for name, volume in volumes.items():
            beside_fbp = compare(volume.data, volumes[BASELINE].data, _slices_seen(prepared, volume.grid))
            if beside_fbp is None:
                break  # it shows no air
            metrics[name]["air"] = beside_fbp.air
            warn(lost := lost_mass_warning(made, beside_fbp))
            doubtful = doubtful or bool(lost)
    wants_fbp = doubtful and compared and BASELINE in volumes
    keeps_fbp = wants_fbp and partial_volume is None and target.takes_a_second(made.volume.grid)
    if keeps_fbp:
        warn(f"FBP of the same views is kept beside the volume: `beamline view {target.output.name}` shows both.")
    elif wants_fbp:
        warn(
            "FBP of the same views is not kept beside the volume: that takes an .h5 made at once, and room on its "
            "disk. Make it with --method fbp to compare."
        )
    if left_out:
        why = "the reconstruction was stopped" if waited_for else "the seconds asked for were nearly over"
        remark = f"Left out, as {why}: {', '.join(left_out)}."
        sink(StateEntered("left_out", remark, time=clock.now()))
        remarks.append(remark)
    context = replace(context, warnings=remarks)
    own = metrics[made.method]
    phases.enter("report")
    parameters = parameters_of(made, prepared, context)
    deviation = made.deviation
    if region is not None:
        volumes = {method: region.cut(volume) for method, volume in volumes.items()}
        deviation = None if deviation is None else region.cut(deviation)
    record = ReconRecord(
        volume=volumes[made.method],
        length_unit=prepared.length_unit,
        raw_file=str(context.facts.path.resolve()),
        title=f"{label_of(made.method)} reconstruction of {context.facts.name}",
        sample=context.facts.sample or "not stated",
        time=clock.now(),
        parameters=parameters,
        metrics=own,
        history=history_arrays(made.history),
        model={} if made.gaussians is None else arrays_of_model(made.gaussians, prepared.geometry),
        deviation=None if deviation is None else deviation.data,
        fbp=volumes[BASELINE].data if keeps_fbp else None,
    )
    page: Path | None = None
    try:
        if target.report is not None:
            report = compose(made, prepared, truth, volumes, metrics, parameters, context, left)
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
            units=f"1/{prepared.length_unit}",
            elapsed=clock.now() - context.started,
            times=phases.seconds,
            metrics=own,
            **said,
            hiding=hiding or None,
            chosen=made.chosen or None,
            next_db=made.next_decibel,
            next_db_said=None if made.next_decibel is None else made.next_decibel_text,
            fbp=metrics[BASELINE] if len(metrics) > 1 else None,
            time=clock.now(),
        )
    )
    return own


def _slices_seen(prepared: PreparedProjections, grid: Grid) -> NDArray[np.bool_] | None:
    """[z] whether the slice's row of the detector got beam; None: all did, or rows show no slices."""
    measured, geometry = prepared.measured, prepared.geometry
    if measured is None or not geometry.rows_show_slices or grid.shape[0] != len(measured):
        return None
    return np.asarray(measured.any(axis=1))


def parameters_of(made: ReconOutcome, prepared: PreparedProjections, context: ReportContext) -> dict[str, Value]:
    """All parameters of the volume, by name."""
    selection, geometry = context.selection, prepared.geometry
    rows = selection.rows
    return {
        "method": made.method,
        "axis_col": prepared.axis_col,
        **_axis_parameters(prepared.axis),
        "views": selection.views,
        "view_frames": prepared.projections.view_ids,
        "view_angles_deg": np.degrees(geometry.angles),
        "n_views": geometry.n_views,
        "n_projections": prepared.n_projections,
        "views_left_out": prepared.left_out,
        **({} if prepared.view_weights is None else {"view_weights": prepared.view_weights}),
        "rows": "all" if rows is None else f"{rows[0]}:{rows[1]}",
        **({} if context.region is None else {"roi": str(context.region.region)}),
        **({"columns": context.facts.columns} if context.facts.columns else {}),
        "binning": selection.binning,
        "pixel_pitch": geometry.pixel_pitch,
        "pixel_pitch_unit": prepared.length_unit,
        "quantity": prepared.quantity,
        **(done := recorded(selection.in_order, prepared.done)),
        **({"view_shifts_px": geometry.shifts} if "jumps" in done or geometry.shifts.any() else {}),
        **({"view_roll_deg": np.degrees(geometry.roll)} if geometry.roll.any() else {}),
        **({"view_tilt_deg": np.degrees(geometry.tilt)} if geometry.tilt.any() else {}),
        **({} if geometry.is_straight and not geometry.shifts.any() else {"sample_pitch": geometry.sample_pitch}),
        "floored_fraction": float(prepared.projections.floored),
        "masked_fraction": float(prepared.projections.masked.mean()),
        "replaced_fraction": float(prepared.projections.replaced),
        "filter": made.filter,
        "seed": context.seed,
        **_flat("", made.settings),
        **{f"seconds_of_{re.sub(r'[^a-zA-Z]+', '_', name)}": took for name, took in context.phases.seconds.items()},
        "command": context.command,
        **({"recipe": context.recipe} if context.recipe else {}),
    }


def _flat(prefix: str, values: Mapping[str, Any]) -> dict[str, Value]:
    """Nested settings by joined names; values without an HDF5 type become text."""
    out: dict[str, Value] = {}
    for key, value in values.items():
        name = f"{prefix}_{key}" if prefix else key
        if isinstance(value, Mapping):
            out |= _flat(name, value)
        else:
            out[name] = value if isinstance(value, int | float | np.ndarray) else str(value)
    return out


def _axis_parameters(axis: AxisEstimate | None) -> dict[str, Value]:
    if axis is None:
        return {"axis_source": "given, or stated in the file"}
    return {
        "axis_source": axis.method,
        "axis_confident": axis.confident,
        "axis_binned": axis.value,
        "axis_candidates": axis.candidates,
        "axis_curve": axis.curve,
    }


def axis_of(parameters: Mapping[str, Value]) -> AxisEstimate | None:
    """How the axis was found, from the parameters of a reconstruction; None if it was given."""
    if "axis_curve" not in parameters:
        return None
    return AxisEstimate(
        value=float(str(parameters["axis_binned"])),
        candidates=np.asarray(parameters["axis_candidates"]),
        curve=np.asarray(parameters["axis_curve"]),
        confident=bool(parameters["axis_confident"]),
        method=str(parameters["axis_source"]),
    )
