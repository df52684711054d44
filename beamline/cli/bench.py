"""`beamline bench`: measures times and qualities, to compare machines and versions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import click

from beamline.cli.json_output import json_events
from beamline.cli.options import json_option
from beamline.core.events import Event
from beamline.core.machine import machine, machine_line
from drivers.clock import SystemClock
from recon.bench import N_GAUSSIANS, SIDE, Timing, VolumeRow, kernel_timings, step_timing, volume_rows
from recon.methods import by_name, names
from recon.splatting.r2 import R2
from recon.warm_up import warm_up

_STEPS = (125, 500, 2000)


@click.group()
def bench() -> None:
    """Measure this machine."""


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
    clock = SystemClock()
    with json_events(as_json) as sinks:

        def tell(kind: str, data: dict[str, Any], text: str) -> None:
            for sink in sinks:
                sink(Event(kind, clock.now(), data))
            if not sinks:
                click.echo(text)

        found = machine()
        tell("bench_started", {"machine": found}, machine_line(found) + "\n")
        click.echo("Compiling kernels that are not in the cache.", err=True)
        warm_up()
        for timing in _timings(gaussians, side):
            tell("bench", {**asdict(timing), "ns_per_pair": timing.ns_per_pair}, _line(timing))
        for row in _rows() if volumes else ():
            tell("bench", asdict(row), _volume_line(row))
        for sink in sinks:
            sink(Event("done", clock.now(), {}))


def _timings(gaussians: int, side: int) -> Iterator[Timing]:
    yield from kernel_timings(time.perf_counter, gaussians, side)
    yield step_timing(time.perf_counter, gaussians, side)


def _rows() -> Iterator[VolumeRow]:
    others = [by_name(name) for name in names()]
    yield from volume_rows(time.perf_counter, [*map(R2, _STEPS), *(method() for method in others if method is not R2)])


def _line(timing: Timing) -> str:
    text = f"{timing.name:<12}{timing.ms:8.2f} ms  (quartiles {timing.spread_ms:.2f})"
    return text + (f"  {timing.ns_per_pair:.3f} ns a pair of {timing.pairs:.3g}" if timing.pairs else "")


def _volume_line(row: VolumeRow) -> str:
    return f"{row.method:<12}{row.seconds:8.2f} s   {row.psnr:6.2f} dB  SSIM {row.ssim3d:.4f}  {row.settings}".rstrip()
