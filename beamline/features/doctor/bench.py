"""`beamline bench`: measures times and qualities, to compare machines and versions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import POSITIVE, json_events, json_option, parsed
from beamline.cli.terminal import events_shown
from beamline.core.events import BenchDone, BenchStarted, Done, Event, TrialReached
from beamline.core.machine import machine, machine_line
from beamline.core.machine_speed import seconds_left
from beamline.core.text import size
from drivers import orca_quest
from drivers.base.clock import SystemClock
from recon.base.choices import N_GAUSSIANS, SIDE
from recon.methods import by_name, names_of_one_volume

if TYPE_CHECKING:
    from beamline.features.doctor.rate import Load, RateRow
    from recon.features.bench.bench import Timing, VolumeRow

_STEPS = (125, 500, 2000)


@click.group()
def bench() -> None:
    """Measure this machine."""


def _frame_size(value: str) -> tuple[int, int]:
    words = value.lower().split("x")
    if len(words) != 2 or not all(word.isdecimal() and 16 <= int(word) <= 32_768 for word in words):
        raise ValueError(f"{value!r} is no size of a frame; expected rows x columns, of 16 to 32768, as in 2304x4096.")
    return int(words[0]), int(words[1])


@bench.command(short_help="Measure how fast frames are taken, checked and written.")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option(
    "--config",
    "file",
    type=click.Path(path_type=Path),
    help="Frame, preview, flushes and checks of this configuration; default: the full sensor, and the defaults.",
)
@click.option(
    "--size",
    "shape",
    metavar="ROWSxCOLS",
    callback=parsed(_frame_size),
    help="Rows and columns of a frame, instead of the camera's.",
)
@click.option("--seconds", type=POSITIVE, default=60.0, show_default=True, help="For all rounds; not the warm-up.")
@click.option(
    "--rounds", type=click.IntRange(1, 100), default=5, show_default=True, help="In each, every stage is measured once."
)
@json_option
def acquire(
    folder: Path, file: Path | None, shape: tuple[int, int] | None, seconds: float, rounds: int, as_json: bool
) -> None:
    """Measure how fast frames are taken, checked and written to FOLDER, which is on the disk for scans.

    Five stages, one part of the acquisition more in each: a plain file with the same bytes, the writer of scans, its
    digest, the monitor, all of it behind the queue of a scan. Half of the free disk is used at most, and every file is
    removed. Run it on an idle machine; ratios of one round are more reliable than rates.
    """
    from beamline.features.doctor.rate import rates, summary

    clock, taken = SystemClock(), []
    with events_shown(as_json) as sink:
        work = _load(file, shape)
        facts = machine()
        start = {"machine": facts, "folder": folder.absolute(), "rows": work.shape[0], "cols": work.shape[1]}
        sink(BenchStarted(start, time=clock.now()))
        if not as_json:
            frame = f"{work.shape[0]} x {work.shape[1]} pixels, {size(work.frame_bytes)} a frame"
            click.echo(f"{machine_line(facts)}\n{frame}, previews of {work.preview_bin} x {work.preview_bin}\n")
        began = clock.now()

        def progress(n: int, of: int, stage: str) -> None:
            spent = clock.now() - began
            per_min = 60 * n / max(spent, 1e-9)
            sink(TrialReached("bench", n, of, stage, seconds_left(n, of, spent), per_min, time=clock.now()))

        for one in rates(work, folder, clock, seconds, rounds, progress):
            taken.append(one)
        rows = summary(work, taken)
        for row in rows:
            sink(BenchDone(row, time=clock.now()))
        sink(Done({}, time=clock.now()))
    if not as_json:
        click.echo(_rate_table(rows, rounds))


def _load(file: Path | None, shape: tuple[int, int] | None) -> Load:
    from beamline.config.load import camera_settings, load
    from beamline.config.models import StorageSection
    from beamline.config.monitor import configured_checks
    from beamline.features.doctor.rate import Load
    from drivers.base.protocols import TriggerSource

    if file is None:
        return Load(shape or orca_quest.SENSOR_SHAPE, StorageSection().preview_bin, StorageSection().flush_every)
    config = load(file)
    camera, storage = config.devices.camera, config.storage
    settings = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL)
    work = Load(
        camera.timing_of(settings).shape, storage.preview_bin, storage.flush_every, configured_checks(config.monitor)
    )
    return work if shape is None else replace(work, shape=shape)


def _rate_table(rows: list[RateRow], rounds: int) -> str:
    plain = rows[0].stage
    lines = [f"{'':<27}{'MB/s':>7}{'frames/s':>10}{'ms':>8}{'CPU ms':>8}   of {plain:<22}{'lost':>5}{'memory':>9}"]
    for row in rows:
        ratio = f"{row.ratio:.2f}  ({row.lowest:.2f} to {row.highest:.2f})"
        memory = "-" if row.peak is None else size(row.peak)
        rate = f"{row.mb_per_s:>7.0f}{row.frames_per_s:>10.1f}{row.ms:>8.2f}{row.cpu_ms:>8.2f}"
        lines.append(f"{row.stage:<27}{rate}   {ratio:<25}{row.lost:>5}{memory:>9}")
    times = "1 round" if rounds == 1 else f"{rounds} rounds in turn"
    lines.append(
        f"\nMedians of {times} (ratios: lowest to highest) of {rows[0].frames} frames, ms a frame until all are on the "
        "disk;\nmemory: the largest of this process."
    )
    return "\n".join(lines)


@bench.command(short_help="Measure kernels, a fit, and methods on a small sample.")
@click.option(
    "--gaussians",
    type=click.IntRange(min=1),
    default=N_GAUSSIANS,
    show_default=True,
    help="Number of Gaussians for kernels and fit.",
)
@click.option(
    "--side", type=click.IntRange(min=16), default=SIDE, show_default=True, help="Rows and columns of a view, px."
)
@click.option(
    "--volumes/--no-volumes", default=True, show_default=True, help="Also reconstruct a small sample with each method."
)
@json_option
def recon(gaussians: int, side: int, volumes: bool, as_json: bool) -> None:
    """Measure the kernels, one step of the fit, and time and quality of each method on a small simulated sample.

    Nothing is written. Run it on an idle machine; ratios within one run are more reliable than times.
    """
    from recon.warm_up import warm_up

    clock = SystemClock()
    with json_events(as_json) as sink:

        def show(event: Event, text: str) -> None:
            sink(replace(event, time=clock.now()))
            if not as_json:
                click.echo(text)

        facts = machine()
        show(BenchStarted({"machine": facts}), machine_line(facts) + "\n")
        click.echo("Compiling kernels that are not in the cache.", err=True)
        warm_up()
        for timing in _timings(gaussians, side):
            show(BenchDone({**asdict(timing), "ns_per_pair": timing.ns_per_pair}), _line(timing))
        for row in _rows() if volumes else ():
            show(BenchDone(row), _volume_line(row))
        sink(Done({}, time=clock.now()))


def _timings(gaussians: int, side: int) -> Iterator[Timing]:
    from recon.features.bench.bench import kernel_timings, step_timing

    yield from kernel_timings(time.perf_counter, gaussians, side)
    yield step_timing(time.perf_counter, gaussians, side)


def _rows() -> Iterator[VolumeRow]:
    from recon.features.bench.bench import volume_rows
    from recon.splatting.r2 import R2

    others = [by_name(name) for name in names_of_one_volume()]
    yield from volume_rows(time.perf_counter, [*map(R2, _STEPS), *(method() for method in others if method is not R2)])


def _line(timing: Timing) -> str:
    text = f"{timing.name:<12}{timing.ms:8.2f} ms  (quartiles {timing.spread_ms:.2f})"
    return text + (f"  {timing.ns_per_pair:.3f} ns a pair of {timing.pairs:.3g}" if timing.pairs else "")


def _volume_line(row: VolumeRow) -> str:
    return f"{row.method:<12}{row.seconds:8.2f} s   {row.psnr:6.2f} dB  SSIM {row.ssim3d:.4f}  {row.settings}".rstrip()
