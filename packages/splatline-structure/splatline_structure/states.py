"""`beamline structure --states`: measures the particles of a reference in later scans with few projections."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import click
import numpy as np

from beamline.api import Selection
from beamline.cli.recipe import typed_line
from beamline.cli.terminal import Answer
from beamline.core.errors import ConfigError, DataError
from beamline.core.events import json_of
from beamline.core.files import atomic_file
from beamline.core.text import count, csv_text, rounded, size
from beamline.projections.prepare import prepare_projections
from beamline.projections.views import select
from beamline.report.html import render
from beamline.storage.readers.open import open_scan
from beamline.storage.volumes.files import opened_volume
from recon.features.reference.particle_states import (
    STEPS,
    ParticleFit,
    ReferenceParticles,
    StateNumbers,
    fit_state,
    numbers_of,
    reference_particles,
)
from splatline_structure import results, state_pictures
from splatline_structure.materials import F32, label_values, labelled, materials_of
from splatline_structure.particles import Numbers, cleaned, parted
from splatline_structure.volumes import box_in

BYTES_A_VOXEL, BYTES_A_RAY = 230, 30
"""Peak memory; measured: 185 bytes a voxel and 21 a ray, with 0.2 GB for the program."""
_PITCH = 0.01  # largest relative difference between a pixel of a state and a voxel of the reference
_VERDICTS = "as before", "cracked", "closed", "gone", "not seen"
_HEAD = (
    "state", "at", "particle", "z_um", "y_um", "x_um", "diameter_um", "cut", "verdict",
    "grey_per_mm", "grey_low", "grey_high", "grey_change_percent", "grey_change_low", "grey_change_high",
    "volume_change_percent", "volume_change_low", "volume_change_high",
    "shift_z_um", "shift_z_low", "shift_z_high", "shift_y_um", "shift_y_low", "shift_y_high",
    "shift_x_um", "shift_x_low", "shift_x_high",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class MeasuredState:
    """A state and the numbers measured in it.

    Attributes:
        at: value of the state on the axis `Series.across`: its charge, the time in h since the first state, or its
            number.
        matches: False if most particles of the reference are missing in the state, so that it is another sample.
    """

    path: Path
    at: float
    n_views: int
    numbers: StateNumbers
    matches: bool


@dataclass(frozen=True, eq=False)
class Series:
    """A reference and its states.

    Attributes:
        path, record: path and record of the volume of the reference.
        labels: labels [z, y, x] of the particles.
        across: meaning of `MeasuredState.at`.
    """

    path: Path
    record: Any
    reference: ReferenceParticles
    labels: Numbers
    states: list[MeasuredState]
    across: str


def measure_states(paths: Sequence[Path], output: Path, answer: Answer, values: dict[str, Any]) -> None:
    """Measure the particles of the volume in the first file in the scans of all other files, and write the folder.

    Raises:
        DataError: a file cannot be used. Nothing was written then.
        ConfigError: an option is wrong, or there is too little memory.
    """
    first, *scans = paths
    if not scans:
        raise click.UsageError("--states needs the volume of the reference and the scan of at least one state.")
    charge = values["charge"]
    if charge is not None and len(charge) != len(scans):
        raise click.UsageError(f"--charge has {len(charge)} values, but there are {count(len(scans), 'state')}.")
    record, data = _volume(first, values)
    begun = [_first_time(path, record, values) for path in scans]
    reference, labels = _particles(first, data, record, values)
    steps = STEPS * len(scans)
    progress, done = answer.counting("steps of the fit"), 0

    def tell() -> None:
        nonlocal done
        done += 1
        progress(done, steps)

    states = []
    across, positions = _abscissa(charge, begun)
    for path, x in zip(scans, positions, strict=True):
        fit, n_views = _fitted(path, record, reference, answer.warn, tell)
        states.append(MeasuredState(path, x, n_views, numbers_of(reference, fit), fit.matches))
        if not fit.matches:
            answer.warn(
                f"{path} shows another sample than {first}, or most of the sample has changed: at most 65 % of the "
                "particles of the reference were found in this scan, or the grey levels of the particles fell to less "
                "than half of those in the reference. The numbers of this state are not determined. Check the files, "
                "or take a later state as the reference."
            )
    if not any(state.matches for state in states):
        raise DataError(
            f"No scan of a state shows the sample of the reference {first}. Give a reference of the same sample. "
            "Nothing was written."
        )
    series = Series(first, record, reference, labels, states, across)
    _write(series, output, values, answer)


def _volume(path: Path, values: dict[str, Any]) -> tuple[Any, F32]:
    """The reference, with lengths in mm, and its voxels."""
    with opened_volume(path, values["dataset"]) as record:
        if record.length_unit != "mm":
            raise DataError(
                f"{path} does not state the voxel size. Reconstruct a scan that states the pixel size. Nothing was "
                "written."
            )
        grid = record.grid
        if not math.isclose(grid.spacing[0], grid.voxel_size, rel_tol=_PITCH):
            raise DataError(
                f"The voxels of {path} must be cubes: reconstruct the reference with a slice height equal to the "
                "voxel width. Nothing was written."
            )
        needed = BYTES_A_VOXEL * math.prod(grid.shape)
        if needed > values["memory"]:
            shape = " x ".join(map(str, grid.shape))
            raise DataError(
                f"{path}: not enough memory. {shape} voxels need {size(rounded(needed, up=True))}, and "
                f"{size(values['memory'])} are allowed. Free memory, give more --memory, or reconstruct the reference "
                "from fewer rows (`recon --rows`). Nothing was written."
            )
        data = np.array(record.volume.data[: grid.shape[0]], np.float32)
        if wrong := int(np.count_nonzero(~np.isfinite(data))):
            raise DataError(f"{wrong} of {data.size} voxels of {path} are not finite. Nothing was written.")
        return record, data


def _particles(path: Path, data: F32, record: Any, values: dict[str, Any]) -> tuple[ReferenceParticles, Numbers]:
    """The parts of the reference, and the labels of its particles [z, y, x]."""
    n_materials = values["materials"] or 2
    particles = values["particles"] or n_materials
    if particles > n_materials:
        raise ConfigError(f"There is no material {particles}: the {n_materials} materials are numbered from 1. "
                          "Nothing was written.")  # fmt: skip
    if particles == 1:
        raise ConfigError(
            "--particles 1 is the least dense material, but particles must be denser than what is around them. "
            "Nothing was written."
        )
    try:
        if label_values(data).size:
            raise ValueError("the file contains labels, and grey values are expected")
        thresholds = materials_of(np.ascontiguousarray(data[box_in(data, "square")]), n_materials).thresholds
        mask = labelled(data, thresholds) == particles - 1
        labels = parted(cleaned(mask, values["radius"], values["smallest"]), values["neck"])
        return reference_particles(data, labels, record.grid), labels
    except ValueError as error:
        raise DataError(f"{path} cannot be the reference: {error}. Nothing was written.") from error


def _first_time(path: Path, record: Any, values: dict[str, Any]) -> float:
    """Time of the first projection in s; NaN if the file has no times. Raises DataError if the scan cannot be used."""
    with open_scan(path) as source:
        if source.cone is not None:
            raise DataError(
                f"{path} is a cone-beam scan, but `--states` needs parallel-beam scans. Nothing was written."
            )
        side = int(record.parameters.get("binning", 1))
        rays = math.prod(source.shape) // side**2 * int(source.table.views.size)
        needed = BYTES_A_VOXEL * math.prod(record.grid.shape) + BYTES_A_RAY * rays
        if needed > values["memory"]:
            raise DataError(
                f"{path}: not enough memory. This file needs {size(rounded(needed, up=True))}, and "
                f"{size(values['memory'])} "
                "are allowed. Free memory, or give more --memory. Nothing was written."
            )
        pixel = source.pixel_size_mm
        if pixel is not None and not math.isclose(pixel * side, record.grid.voxel_size, rel_tol=_PITCH):
            raise DataError(
                f"{path}: the pixels are {1e3 * pixel * side:.4g} µm wide (binning {side} x {side}), but the reference "
                f"has voxels of {1e3 * record.grid.voxel_size:.4g} µm. Reconstruct the reference with voxels as wide "
                "as these pixels. Nothing was written."
            )
        times = source.table.times
        return math.nan if times is None else float(np.nanmin(times[source.table.views]))


def _abscissa(charge: list[float] | None, begun: list[float]) -> tuple[str, list[float]]:
    """The quantity on the horizontal axis of curves, and its value for each state."""
    if charge is not None:
        return "state of charge", charge
    if all(map(math.isfinite, begun)) and len(set(begun)) == len(begun):
        return "time since the first state (h)", [(each - min(begun)) / 3600 for each in begun]
    return "number of the state", [float(k) for k in range(1, len(begun) + 1)]


def _fitted(
    path: Path,
    record: Any,
    reference: ReferenceParticles,
    warn: Callable[[str], None],
    tell: Callable[[], None],
) -> tuple[ParticleFit, int]:
    """The fit of a scan, and the number of its projections."""
    facts = record.parameters
    rows: Any = None if facts.get("rows", "all") == "all" else tuple(map(int, str(facts["rows"]).split(":")))
    with open_scan(path) as source:
        picked = select(source, Selection(rows=rows, binning=int(facts.get("binning", 1))))
        prepared = prepare_projections(picked, warn)
    geometry = prepared.geometry
    if geometry.is_cone or not geometry.is_straight:
        raise DataError(
            f"{path}: states are measured only with a parallel beam that is not tilted. Nothing was written."
        )
    if prepared.origin.length_unit != "mm":
        geometry = geometry.scaled(record.grid.voxel_size / geometry.sample_pitch)
    used = prepared.views.masked()
    try:
        fit = fit_state(reference, used.data, geometry, used.weights, tell)
    except ValueError as error:
        raise DataError(f"{path} cannot be measured: {error}. Nothing was written.") from error
    return fit, geometry.n_views


def _write(series: Series, output: Path, values: dict[str, Any], answer: Answer) -> None:
    """Write the folder, and print a line for each state."""
    path, states, reference, record = series.path, series.states, series.reference, series.record
    settings = {
        "reference": path, "states": len(states), "command": typed_line(click.get_current_context()),
        **{name: value for name, value in values.items() if value is not None},
    }  # fmt: skip
    columns = ["projections", *(f"particles {name}" for name in _VERDICTS), "grey change (%), median",
               "10 % to 90 %", "volume change (%), median", "10 % to 90 %"]  # fmt: skip
    summary = [_summary(state) for state in states]
    sentences = [
        f"The reference has {count(len(reference.bodies), 'particle')}, of which {int(reference.cut.sum())} touch "
        "the lowest or the highest slice. Medians and shares leave out particles that touch these slices.",
        "Each interval should contain the true number in 80 % of all cases. The intervals do not include the errors "
        "of the reference itself.",
    ]
    cut = reference.cut
    cells = [_cells(state, cut) for state in states]
    rows = [
        {"label": state.path.name, "cells": values, "marked": False}
        for state, values in zip(states, cells, strict=True)
    ]
    page = render(
        "trials.html", title=f"Particles of {path.name} in {count(len(states), 'state')}", summary="",
        sentences=sentences, pictures=state_pictures.pictures_of(reference, states, series.across), bold=False,
        heading="States", columns=columns, rows=rows, scan={name: str(each) for name, each in settings.items()},
        command=str(settings["command"]),
    )  # fmt: skip
    texts = {
        "report.html": page,
        "particles.csv": csv_text([_HEAD, *(row for state in states for row in _rows(reference, state))]),
        "states.json": json_of({**settings, "across": series.across, "states": summary}),
    }
    with atomic_file(output) as partial:
        results.write_all(partial, texts, {f"particles.{values['labels']}": series.labels}, record, record.grid)
    lines = [
        f"{state.path.name}: " + ", ".join(f"{name} {value}" for name, value in zip(columns, values, strict=True))
        for state, values in zip(states, cells, strict=True)
    ]
    answer.done({"output": output, "across": series.across, "states": summary}, *lines, f"output  {output}")


def _whole(state: MeasuredState, cut: np.ndarray) -> np.ndarray:
    """The particles that are counted, and whose numbers describe a state."""
    return np.array([v in ("as before", "cracked", "closed") for v in state.numbers.verdict]) & ~cut


def _summary(state: MeasuredState) -> dict[str, Any]:
    """The values of the state for programs."""
    verdicts: list[str] = list(state.numbers.verdict)
    return {
        "scan": state.path, "at": state.at, "projections": state.n_views, "matches": state.matches,
        **{name.replace(" ", "_"): verdicts.count(name) for name in _VERDICTS},
    }  # fmt: skip


def _cells(state: MeasuredState, cut: np.ndarray) -> list[str]:
    numbers, verdicts = state.numbers, list(state.numbers.verdict)
    counts = [str(sum(v == name for v, c in zip(verdicts, cut, strict=True) if not c)) for name in _VERDICTS]
    typical, shown = _whole(state, cut), list[str]()
    for each in (numbers.grey_change, numbers.growth):
        of_typical = 100 * each[typical, 0]
        low, middle, high = np.percentile(of_typical, (10, 50, 90)) if typical.any() else (np.nan,) * 3
        shown += [f"{middle:.2f}", f"{low:.2f} to {high:.2f}"]
    return [str(state.n_views), *counts, *shown]


def _rows(reference: ReferenceParticles, state: MeasuredState) -> list[list[object]]:
    """A row of the table for each particle; numbers that are not determined are empty."""
    numbers, grid = state.numbers, reference.grid
    first, edge = 1e3 * np.array(grid.first), 1e3 * grid.voxel_size
    centres = np.array([body.centre for body in reference.bodies])[:, [2, 0, 1]] * edge + first
    diameters = np.cbrt(6 * reference.voxels / np.pi) * edge
    rows: list[list[object]] = []
    for k, body in enumerate(reference.bodies):
        figures = (*numbers.grey[k], *(100 * numbers.grey_change[k]), *(100 * numbers.growth[k]),
                   *(1e3 * numbers.shift[k]).ravel())  # fmt: skip
        rows.append([
            state.path.name, f"{state.at:.6g}", body.number, *(f"{each:.6g}" for each in (*centres[k], diameters[k])),
            int(reference.cut[k]), numbers.verdict[k], *(f"{each:.5g}".replace("nan", "") for each in figures),
        ])  # fmt: skip
    return rows
