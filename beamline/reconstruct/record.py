"""Record: writes the result of a reconstruction: the volume file, then the report with its figures of merit."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from beamline.core.events import Sink, Warned
from beamline.core.quantities import cone_facts
from beamline.core.recon_events import VolumeDone
from beamline.core.text import spans
from beamline.projections.registry import in_order, recorded
from beamline.reconstruct.options import OutputPaths
from beamline.reconstruct.scan_facts import MadeVolume, ReportContext, label_of
from beamline.reconstruct.volume_checks import CheckedVolume, check_volume
from beamline.report.history import history_arrays
from beamline.storage import hdf5
from beamline.storage.pose_table import CENTRES_KEPT
from beamline.storage.recon_record import ReconRecord, Value, VoxelsInFile, recorded_ending
from beamline.storage.volumes.files import opened_volume, write_volume
from drivers.base.clock import Clock
from recon.base.geometry import Geometry
from recon.base.method import Reconstruction
from recon.base.volume import Grid, Volume
from recon.methods import BASELINE
from recon.prep.align import AxisEstimate
from recon.splatting.gaussians import Gaussians
from recon.voxels import view_weights


def arrays_of_model(gaussians: Gaussians, geometry: Geometry) -> dict[str, Any]:
    """The arrays of a model as they are written to a file, by name. They are physical values, so that other programs
    need not know how the fit parametrises them.
    """
    return {
        "kernel": gaussians.kernel.value,
        "density_unit": gaussians.density_unit,
        **gaussians.physical(),
        "view_angles": geometry.angles,
        "view_shifts": geometry.shifts,
        "view_roll": geometry.roll,
        "view_tilt": geometry.tilt,
        **({"view_centres": geometry.centres} if geometry.centres.any() else {}),
        "detector_shape": np.array(geometry.detector_shape),
        "pixel_pitch": geometry.pixel_pitch,
        "axis": np.array([geometry.axis_col, geometry.axis_row]),
        "source_distances": np.array([geometry.sod, geometry.sdd]),
    }


def write_result(outcome: MadeVolume, sink: Sink, clock: Clock) -> ReconRecord:
    """Assess the volume, write its file and the report, and send the event `done` with the returned record.

    The voxels of the record are read from the file when they are used. If no file is written, the record contains the
    volume.

    Raises:
        DataError: the volume could not be written; no incomplete file remains. If only the report fails, a warning is
            given instead.
    """
    phases, target, ordinary = (
        outcome.context.phases,
        outcome.target,
        replace(outcome, prepared=outcome.prepared.centred),
    )
    phases.enter("checking the volume")
    checked = check_volume(ordinary, sink, clock)
    remarks = [*checked.warnings, *([checked.skipped_text] if checked.skipped_text else [])]
    context = replace(outcome.context, warnings=remarks)
    record, volumes = _record(replace(outcome, context=context), checked, clock.now())
    phases.enter("writing the volume")
    if target.written:
        write_volume(target.output, record, replace=target.replace)
    state_time: Callable[[float], None] | None = None  # writes the time on the page
    if target.report is not None:
        phases.enter("report")
        try:
            state_time = _report(replace(ordinary, context=context), checked, volumes, record.parameters)
        except Exception as error:  # the volume is complete, even if its page is not
            sentence = f"No report was written ({type(error).__name__}: {error}). The volume is complete."
            sink(Warned(sentence, time=clock.now()))
            record = replace(record, report=None, warnings=(*record.warnings, sentence))
    phases.end()
    elapsed = clock.now() - context.started
    if state_time is not None:
        state_time(elapsed)
    # this reads the voxels, so it comes before they are moved to files
    record = replace(record, elapsed=elapsed, times=phases.seconds)
    record = _with_voxels_in_files(record, target)
    sink(VolumeDone(record, time=clock.now()))
    return record


def _report(
    outcome: MadeVolume, checked: CheckedVolume, volumes: Mapping[str, Volume], parameters: Mapping[str, Value]
) -> Callable[[float], None]:
    """Write the page. Returns a function that writes on the page how long the whole command took (in s)."""
    from beamline.reconstruct.report import compose  # imported here, because matplotlib takes a second
    from beamline.report.html import write_report, write_timed

    target = outcome.target
    assert target.report is not None
    report = compose(outcome, volumes, checked, parameters)
    report = replace(report, volume=target.output.name if target.written else "")
    write_report(target.report, report, replace=target.replace)
    return partial(write_timed, target.report, report, label_of(outcome.result.method))


def _record(outcome: MadeVolume, checked: CheckedVolume, now: float) -> tuple[ReconRecord, dict[str, Volume]]:
    """The record of the volume, and the volumes of the report by method. If the options ask for a region, they are
    those of the region.
    """
    result, prepared, target, context = outcome.result, outcome.prepared, outcome.target, outcome.context

    def written(volume: Volume) -> Volume:
        return prepared.with_true_heights(volume if context.region is None else context.region.cut(volume))

    volumes = {method: written(volume) for method, volume in checked.volumes.items()}
    record = ReconRecord(
        volume=volumes[result.method],
        length_unit=prepared.origin.length_unit,
        raw_file=str(context.facts.path.resolve()),
        title=_title(result, context),
        sample=context.facts.sample or "not stated",
        time=now,
        parameters=parameters_of(outcome),
        metrics=checked.metrics[result.method],
        history=history_arrays(result.history),
        model={} if result.gaussians is None else arrays_of_model(result.gaussians, prepared.geometry),
        deviation=None if result.deviation is None else written(result.deviation).data,
        change=None if result.change is None else written(result.change).data,
        displacement=result.displacement,
        series=result.series,
        compared=checked.metrics.get(BASELINE) if len(checked.metrics) > 1 else None,
        warnings=tuple(checked.warnings),
        hiding=checked.hiding_warning,
        chosen=result.chosen,
        output=target.output,
        report=target.report,
    )
    return record, volumes


def _title(result: Reconstruction, context: ReportContext) -> str:
    if result.series is not None:
        return f"{result.series.n} volumes at successive times of {context.facts.name}"
    return f"{label_of(result.method)} reconstruction of {context.facts.name}"


def _with_voxels_in_files(record: ReconRecord, target: OutputPaths) -> ReconRecord:
    """A copy of the record whose voxels are read from its file when they are used. If no file is written, the copy
    contains the volume in memory.
    """
    volume, series = record.volume, record.series
    if target.written:
        time_index = None if series is None else 0
        voxels: Any = VoxelsInFile(volume.grid.shape, partial(_voxels, target.output, time_index))
        volume = replace(volume, data=voxels)
        if series is not None:
            series = replace(series, data=VoxelsInFile(series.data.shape, partial(_dataset, target.output)))
    else:
        volume = replace(volume, data=np.array(volume.data))  # the volume may lie in a temporary file
    return replace(record, volume=volume, series=series, deviation=None, change=None, displacement=None, model={})


def _voxels(path: Path, index: int | None, part: Any) -> NDArray[np.float32]:
    """Part [z, y, x] of the volume of a file; if the file has several volumes, of volume number `index`."""
    with opened_volume(path, at=index) as stored:
        return np.array(stored.volume.data[part])


def _dataset(path: Path, part: Any) -> NDArray[np.float32]:
    with hdf5.open_hdf5(path) as file, hdf5.readable(path):
        return np.asarray(file["entry/data/data"][part])


def parameters_of(outcome: MadeVolume) -> dict[str, Value]:
    """All parameters of the volume, by name."""
    result, prepared, context = outcome.result, outcome.prepared, outcome.context
    selection, geometry, facts = context.selection, prepared.geometry, context.facts
    done, cols = recorded(in_order(selection), prepared.origin.done), geometry.detector_shape[1]
    parameters: dict[str, Value] = {
        "method": result.method,
        "axis_col": prepared.origin.axis_col,
        **_axis_parameters(prepared.origin.axis),
        "views": selection.views,
        "view_frames": prepared.ids,
        "view_angles_deg": np.degrees(geometry.angles),
        "n_views": geometry.n_views,
        "n_projections": prepared.origin.n_projections,
        "views_left_out": prepared.origin.left_out,
        "rows": "all" if selection.rows is None else f"{selection.rows[0]}:{selection.rows[1]}",
        **_region_parameters(context),
        "binning": selection.binning,
        "pixel_pitch": geometry.pixel_pitch,
        "pixel_pitch_unit": prepared.origin.length_unit,
        **(cone_facts((geometry.sod, geometry.sdd), geometry.pixel_pitch, cols) if geometry.is_cone else {}),
        "quantity": prepared.origin.quantity,
        **done,
        **_pose_parameters(geometry),
        "floored_fraction": float(prepared.corrected.floored),
        "masked_fraction": float(prepared.corrected.masked.mean()),
        "replaced_fraction": float(prepared.corrected.replaced),
        "filter": context.filter,
        "seed": context.seed,
        **_flat("", result.settings),
        **recorded_ending(result.ending),
        **{f"seconds_of_{re.sub(r'[^a-zA-Z]+', '_', name)}": took for name, took in context.phases.seconds.items()},
        "command": context.command,
    }
    parts = np.unique(prepared.corrected.unmeasured[:, 0]), prepared.unmeasured_rows[0]
    unmeasured = zip(("frames_unmeasured_in_part", "rows_unmeasured"), parts, strict=True)
    parameters |= {name: numbers for name, numbers in unmeasured if numbers.size}
    if prepared.sources.view_weights is not None:
        parameters["view_weights"] = prepared.sources.view_weights
    if facts.frames_per_view > 1:
        parameters["frames_per_view"] = facts.frames_per_view
    texts = {"columns": facts.columns, "scan_ended": facts.ended, "recipe": context.recipe}
    return parameters | {name: text for name, text in texts.items() if text}


def _pose_parameters(geometry: Geometry) -> dict[str, Value]:
    """How views were displaced, rolled or tilted, and which slices few views see, as parameters by name."""
    parameters: dict[str, Value] = {}
    if geometry.shifts.any():
        parameters["view_shifts_px"] = geometry.shifts
    if (few := partly_seen(geometry)).size:
        parameters["slices_partly_seen"] = few
    turns = {"view_roll_deg": np.degrees(geometry.roll), "view_tilt_deg": np.degrees(geometry.tilt)}
    parameters |= {name: values for name, values in (turns | {CENTRES_KEPT: geometry.centres}).items() if values.any()}
    if not geometry.is_straight or geometry.shifts.any():
        parameters["sample_pitch"] = geometry.sample_pitch
    return parameters


def partly_seen(geometry: Geometry) -> NDArray[np.intp]:
    """Slices that are seen over a smaller part of the 180° than others, because projections have different heights."""
    if geometry.is_cone or not geometry.is_straight or not geometry.shifts[:, 1].any():
        return np.zeros(0, np.intp)
    heights = Grid.matching(geometry).coordinates()[0]
    return np.flatnonzero(view_weights.partly_seen(geometry, heights / geometry.pixel_pitch + geometry.axis_row))


def partly_seen_warning(geometry: Geometry) -> str:
    """The warning that some slices are seen in few projections; empty if all slices are seen equally."""
    partial_slices = partly_seen(geometry)
    if not partial_slices.size:
        return ""
    which = spans(partial_slices.tolist())
    n_slices = Grid.matching(geometry).shape[0]
    return (
        f"Slices {which} of {n_slices} are seen from fewer angles than the other slices, because the projections are "
        "at different heights. The volume has streaks in these slices, and FBP gives too low densities."
    )


def _region_parameters(context: ReportContext) -> dict[str, Value]:
    if context.region is None:
        return {}
    box = context.region.region
    return {"roi": str(box), **({"roi_found": box.reason} if box.reason else {})}


def _flat(prefix: str, values: Mapping[str, Any]) -> dict[str, Value]:
    """Nested settings as one level, with joined names; values without an HDF5 type become text."""
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
    """How the axis was found, from the parameters of a reconstruction; None if the user gave it."""
    if "axis_curve" not in parameters:
        return None
    return AxisEstimate(
        value=float(str(parameters["axis_binned"])),
        candidates=np.asarray(parameters["axis_candidates"]),
        curve=np.asarray(parameters["axis_curve"]),
        confident=bool(parameters["axis_confident"]),
        method=str(parameters["axis_source"]),
    )
