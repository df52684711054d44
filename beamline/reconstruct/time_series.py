"""One scan of a sample that changes while it is scanned: volumes in time, in one file."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from beamline.core.errors import ConfigError
from beamline.core.events import Sink, StateEntered
from beamline.core.phases import Phases
from beamline.core.signals import StopOnSignal
from beamline.core.sinks import Warnings
from beamline.core.text import size
from beamline.projections.prepare import prepare_projections
from beamline.projections.view_geometry import stated_geometry
from beamline.reconstruct.offline import require_finished
from beamline.reconstruct.options import ReconOptions
from beamline.reconstruct.outcome import ReportContext, facts_of
from beamline.reconstruct.parameters import parameters_of
from beamline.reconstruct.progress import sweeps_told
from beamline.reconstruct.series_report import FACTORS, series_page
from beamline.reconstruct.slabs import memory_of
from beamline.report.html import write_report
from beamline.storage.readers.base import ScanSource
from beamline.storage.recon_record import ReconRecord, VolumesInTime
from beamline.storage.volumes.files import opened_volume
from beamline.storage.writers.recon_file import SUFFIXES, write_reconstruction
from drivers.base.clock import Clock
from recon.assess.time_model import duration_text
from recon.base.arrays import F32, F64, I64
from recon.base.geometry import Geometry
from recon.base.method import Reconstruction
from recon.base.volume import Grid, Volume
from recon.base.work import Rates, seconds_of
from recon.series import SWEEPS, TimedViews, fit_series, series_costs

_COPIES = 7  # of all line integrals: views, lines, a part held out, moments, binned views, weights
_VOLUMES, _FIELDS = 8, 12  # volumes in memory: for each volume of the series; for displacements and what they displace


@dataclass(frozen=True)
class SeriesRequest:
    """What is asked of a series.

    Attributes:
        volumes: 2 or more, at even times from the first view to the last.
        moves: matter moves, too; None: where views held out are predicted better so.
    """

    volumes: int
    moves: bool | None


@dataclass(frozen=True)
class SeriesNeeds:
    """What a series takes.

    Attributes:
        shape: [time, z, y, x].
        memory, allowed: bytes in memory, and those that may be used.
        output: bytes on the disk.
        seconds, least_seconds: that it takes, without reading and correction; None: not estimated.
    """

    shape: tuple[int, int, int, int]
    views: int
    memory: int
    allowed: int
    output: int
    seconds: float | None = None
    least_seconds: float | None = None

    @classmethod
    def of(cls, options: ReconOptions, request: SeriesRequest, geometry: Geometry) -> SeriesNeeds:
        voxels = 4 * math.prod(shape := Grid.matching(geometry).shape)
        rays = 4 * geometry.n_views * math.prod(geometry.detector_shape)
        memory = (_VOLUMES * request.volumes + _FIELDS) * voxels + _COPIES * rays
        return cls((request.volumes, *shape), geometry.n_views, memory, memory_of(options), request.volumes * voxels)

    def refuse(self) -> None:
        """ConfigError where it takes more memory than it may."""
        if self.memory > self.allowed:
            rows = int(self.shape[1] * self.allowed / self.memory)
            fewer = f"--rows with {rows} row{'s' * (rows > 1)} or fewer at a time, or " if rows else ""
            raise ConfigError(
                f"--time {self.shape[0]}: {self.shape[0]} volumes of {self.shape[1:]} voxels take {size(self.memory)} "
                f"of memory, {size(self.allowed)} may be used. Volumes in time are not made in slabs: give {fewer}"
                "--bin. Nothing was written."
            )

    def lines(self) -> list[str]:
        """For people."""
        shape = " x ".join(str(n) for n in self.shape[1:])
        lines = [
            f"{'volumes':<10}{self.shape[0]} of {shape} voxels, from {self.views} views",
            f"{'memory':<10}{size(self.memory)} of {size(self.allowed)}",
            f"{'disk':<10}{size(self.output)} for the result",
        ]
        if self.seconds is None or self.least_seconds is None:
            return lines
        least, most = (duration_text(seconds) for seconds in (self.least_seconds, self.seconds))
        return [*lines, f"{'time':<10}about {least} to {most}, reading and correction not counted"]


def series_needs(options: ReconOptions, request: SeriesRequest, rates: Rates) -> SeriesNeeds:
    """What it takes, before any frame is read. ConfigError where the memory does not suffice, or options do not fit."""
    with options.source.open() as source:
        geometry = stated_geometry(source, options.selection)
    needs = SeriesNeeds.of(options, request, geometry)
    needs.refuse()
    try:
        span = seconds_of(series_costs(geometry, request.volumes, request.moves), rates)
    except ValueError as error:
        raise ConfigError(f"--time {request.volumes}: {error}. Nothing was written.") from error
    return replace(needs, seconds=span.most, least_seconds=span.least)


@dataclass(frozen=True, eq=False)
class TimeSeriesResult:
    """Volumes in time of a scan file.

    Attributes:
        output, report: files; None if not requested.
        shape: [time, z, y, x].
        seconds: [time] of each volume, from the first view on.
        axis_col: rotation axis in columns of the full detector.
        residual: what the volumes leave of the views, over the views.
        moves: matter moves; False: only its density changes.
        factors: each volume is the mean of all, times factors smooth within matter.
        chosen: how `moves` was decided; empty where it was given.
        ended_early: the volumes are those reached when it was stopped.
        grid: of each volume.
        units: of the volumes, 1/mm, or 1/px if the pixel size is unknown.
        warnings: sentences.
    """

    output: Path | None
    report: Path | None
    shape: tuple[int, ...]
    seconds: tuple[float, ...]
    axis_col: float
    residual: float
    moves: bool
    factors: bool
    chosen: str
    ended_early: bool
    grid: Grid
    units: str
    warnings: tuple[str, ...]
    _held: F32 | None = field(default=None, repr=False)

    @cached_property
    def volumes(self) -> F32:
        """The attenuation [time, z, y, x]; read from `output`, if requested, on first use."""
        if self._held is not None:
            return self._held
        assert self.output is not None
        volumes = np.empty(self.shape, np.float32)
        for at in range(len(self.seconds)):
            with opened_volume(self.output, at=at) as record:
                volumes[at] = record.volume.data[:]
        return volumes

    def event_values(self) -> dict[str, Any]:
        """What the event `done` says, by name: all up to `ended_early`."""
        names = [each.name for each in fields(self)]
        return {name: getattr(self, name) for name in names[: names.index("ended_early") + 1]}

    def lines(self) -> list[str]:
        """For people."""
        n, *shape = self.shape
        return [
            f"{'output':<10}{self.output}",
            *([f"{'report':<10}{self.report}"] if self.report else []),
            f"{'volumes':<10}{n} of {' x '.join(map(str, shape))}, {self.seconds[0]:.4g} to {self.seconds[-1]:.4g} s",
            f"{'motion':<10}{'learnt' if self.moves else 'none'}{'; ' * bool(self.chosen)}{self.chosen}",
            *([f"{'densities':<10}{FACTORS}"] if self.factors else []),
            f"{'axis_col':<10}{self.axis_col:.2f}",
            f"{'residual':<10}{self.residual:.4g}",
        ]


def reconstruct_series(
    options: ReconOptions,
    request: SeriesRequest,
    sink: Sink,
    clock: Clock,
    counting: Callable[[str], Callable[[int, int], None]],
    stop: StopOnSignal,
) -> TimeSeriesResult:
    """Fit volumes in time to one scan, and write them.

    Before the first sweep of the fit Ctrl-C interrupts, and nothing is written. From then on it writes the volumes so
    far.

    Raises:
        ConfigError: too little memory, or too few views. DataError: the scan cannot be reconstructed, or the output
            exists. Nothing is written then.
    """
    output = options.target.output
    if output.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"-o {output}: volumes in time go into an HDF5 file; give a name that ends in .h5.")
    options.target.refuse_existing()
    began, warn, phases = clock.now(), Warnings(sink, clock), Phases(sink, clock)
    with options.source.open() as source:
        require_finished(source, options)
        facts = facts_of(source)
        prepared = prepare_projections(
            source, options.selection, warn,
            check=lambda geometry: SeriesNeeds.of(options, request, geometry).refuse(), phases=phases,
        )  # fmt: skip
        times = times_of(source, prepared.projections.view_ids, warn)
    options.target.require_room(SeriesNeeds.of(options, request, prepared.geometry).output)
    phases.enter("reconstruction")
    fit_began = clock.now()
    early, heard = False, sweeps_told(counting, SWEEPS)

    def go_on(sweep: int, residual: float) -> bool:
        nonlocal early
        stop.ready = stop.ready or sweep > 0
        heard(sweep)
        early = stopping()
        return not early

    weights = prepared.ray_weights()
    data = prepared.projections.data if weights is None else np.where(weights > 0, prepared.projections.data, 0)
    try:
        with stop() as stopping:
            views = TimedViews(np.asarray(data, np.float32), prepared.geometry, times, weights)
            made = fit_series(
                views, request.volumes, motion=request.moves, sweeps=SWEEPS, seed=options.seed, go_on=go_on,
                stop=stopping,
            )  # fmt: skip
            early = early or stopping()
    except ValueError as error:
        raise ConfigError(f"--time {request.volumes}: {error}. Nothing was written.") from error
    chosen, fit_seconds = "", clock.now() - fit_began
    if made.unseen_residuals is not None:
        chosen = _chosen(*made.unseen_residuals, moves=made.motion is not None)
        sink(StateEntered("chosen", f"{'Motion' if made.motion else 'No motion'}, by {chosen}.", time=clock.now()))
    phases.enter("writing")
    series = VolumesInTime(made.times - times.min(), np.stack([made.at(at) for at in made.times]))
    shape, settings = (
        series.data.shape,
        {"volumes": request.volumes, "moves": made.motion is not None, "chosen": chosen},
    )
    if made.smooth is not None:
        settings["smooth"] = made.smooth
    first = Reconstruction(
        Volume(series.data[0], made.grid),
        settings | {"view_seconds": times - times.min()} | ({"ended_early": True} if early else {}),
        method="series",
        seconds=fit_seconds,
    )
    context = ReportContext(
        facts,
        options.selection,
        options.command,
        options.seed,
        warn.messages,
        began,
        recipe=options.recipe,
        elapsed=clock.now() - began,
        filter=options.filter,
    )
    record = ReconRecord(
        volume=prepared.stretched(first.volume),
        length_unit=prepared.length_unit,
        raw_file=str(facts.path.resolve()),
        title=f"{request.volumes} volumes in time of {facts.name}",
        sample=facts.sample or "not stated",
        time=clock.now(),
        parameters=parameters_of(first, prepared, context),
        metrics={"seconds": first.seconds, "residual": made.residual},
        series=series,
    )
    options.target.take(record)
    if options.target.report is not None:
        page = series_page(record, context, prepared.geometry.n_views, chosen)
        write_report(options.target.report, replace(page, volume=output.name))
    if options.target.written:
        write_reconstruction(output, record)
    phases.end()
    return TimeSeriesResult(
        output=output,
        report=options.target.report,
        shape=shape,
        seconds=tuple(series.seconds.tolist()),
        axis_col=prepared.axis_col,
        residual=made.residual,
        moves=made.motion is not None,
        factors=made.smooth is not None,
        chosen=chosen,
        ended_early=early,
        grid=record.grid,
        units=record.unit,
        warnings=tuple(warn.messages),
        _held=None if options.target.written else series.data,
    )


def _chosen(still: float, moved: float, moves: bool) -> str:
    """How views held out chose whether matter moves, and what to try where they can hardly tell."""
    judged = f"views held out: residual {still:.4g} where nothing moves, {moved:.4g} with motion"
    if moves or moved >= still:
        return judged
    return f"{judged}, which is less, but too little to be sure: if the sample moved, compare with --moves"


def times_of(source: ScanSource, view_ids: I64, warn: Callable[[str], object]) -> F64:
    """[view] s when each of these views was exposed; evenly spaced in the file's order where it states no times."""
    seconds = source.times
    if seconds is not None and np.isfinite(seconds[view_ids]).all():
        return np.asarray(seconds[view_ids], np.float64)
    period = source.attributes.get("period_s", source.attributes.get("exposure_s", 1.0))
    warn(f"The file states no time of each view. Views count as evenly spaced, {period} s apart, in the file's order.")
    return np.asarray(view_ids * float(period), np.float64)
