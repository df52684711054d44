"""`beamline bench`: what this machine does in which time, for comparing machines and versions."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

import click

from beamline.cli.json_output import json_events
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


@bench.command()
@click.option(
    "--gaussians", type=click.IntRange(min=1), default=N_GAUSSIANS, show_default=True, help="Of kernels and step."
)
@click.option("--side", type=click.IntRange(min=16), default=SIDE, show_default=True, help="Pixels of a view's side.")
@click.option("--volumes/--no-volumes", default=True, show_default=True, help="Reconstruct a small sample, too.")
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def recon(gaussians: int, side: int, volumes: bool, as_json: bool) -> None:
    """Kernels, a step of the fit, and the quality that a small simulated sample gets in a time.

    Nothing is written. Run it on an idle machine; ratios within one run mean more than times.
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
        click.echo("Compiling what is not in the cache yet.", err=True)
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
