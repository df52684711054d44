"""The parameters of a reconstruction: all that is needed to make it again, by name."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from beamline.projections.prepared import PreparedProjections
from beamline.projections.registry import in_order, recorded
from beamline.reconstruct.outcome import ReportContext
from beamline.reconstruct.remarks import partly_seen
from beamline.storage.recon_record import Value
from recon.base.method import Reconstruction
from recon.prep.align import AxisEstimate


def parameters_of(made: Reconstruction, prepared: PreparedProjections, context: ReportContext) -> dict[str, Value]:
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
        **({"scan_ended": context.facts.ended} if context.facts.ended else {}),
        "binning": selection.binning,
        "pixel_pitch": geometry.pixel_pitch,
        "pixel_pitch_unit": prepared.length_unit,
        "quantity": prepared.quantity,
        **prepared.recorded,
        **(done := recorded(in_order(selection), prepared.done)),
        **({"view_shifts_px": geometry.shifts} if "jumps" in done or geometry.shifts.any() else {}),
        **({"slices_partly_seen": few} if (few := partly_seen(geometry)).size else {}),
        **({"view_roll_deg": np.degrees(geometry.roll)} if geometry.roll.any() else {}),
        **({"view_tilt_deg": np.degrees(geometry.tilt)} if geometry.tilt.any() else {}),
        **({} if geometry.is_straight and not geometry.shifts.any() else {"sample_pitch": geometry.sample_pitch}),
        "floored_fraction": float(prepared.projections.floored),
        "masked_fraction": float(prepared.projections.masked.mean()),
        "replaced_fraction": float(prepared.projections.replaced),
        "filter": context.filter,
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
