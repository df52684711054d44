"""`beamline simulate`: frames of a scene without an instrument, their cost, their labels and the truth behind them."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import json_events, json_option, refuse_shared
from beamline.cli.terminal import Terminal, counting
from beamline.core.errors import ConfigError, ScanStopped
from beamline.core.events import CostExplained, Done, Event, Sink
from beamline.core.files import refuse_existing, remove, write_whole
from beamline.core.machine import free_memory, machine, machine_line
from beamline.core.shipped import shipped_scenes
from beamline.core.signals import StopOnSignal, terminated_like_interrupted
from beamline.core.sinks import fan_out
from beamline.core.text import size
from drivers.base.clock import Clock, SystemClock

if TYPE_CHECKING:
    from beamline.simulate.emission import EmissionScene
    from beamline.simulate.scene_file import Scan, SceneFile
    from beamline.simulate.write import SimulatedScan

_OVERRIDE_HELP = "Override a value of the scene, such as detector.shape=[2048,2048]. May be repeated."
_VIEWS = click.IntRange(1)
_SEED = click.IntRange(0, 2**63 - 1)
_FILE = click.Path(path_type=Path, dir_okay=False)


def _print_effects(ctx: click.Context, param: click.Parameter, wanted: bool) -> None:
    if wanted:
        from beamline.simulate.effect_table import effects_text  # here: help needs none of it

        click.echo(effects_text())
        ctx.exit()


@click.command(epilog=f"Scenes that come with the package: {', '.join(shipped_scenes())}.")
@click.argument("scene", metavar="SCENE")
@click.option(
    "--effects",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_effects,
    help="Print all effects that a scene may name, with their parameters, and end.",
)
@click.option(
    "--explain", "explains", is_flag=True, help="Print the steps of computing a frame, in order, with the time of each."
)
@click.option(
    "--frames",
    "views",
    type=_VIEWS,
    metavar="N",
    help="Number of views over the scene's range, at the same speed of the stage. Default: as in the scene.",
)
@click.option(
    "-o", "--output", "--out", "out", type=_FILE, help="Write the scan to this HDF5 file and its labels beside it."
)
@click.option("--truth", type=_FILE, help="Write the sample's attenuation and labels to this HDF5 file.")
@click.option(
    "--truth-bin",
    type=click.IntRange(min=1),
    help="Side of a voxel of the truth in pixels: the --bin of the reconstruction to compare. Default: for 256 voxels.",
)
@click.option("--picture", type=_FILE, help="Write some frames to this PNG file. Default: beside --out.")
@click.option("--seed", type=_SEED, metavar="N", default=0, show_default=True, help="Seed of all random numbers.")
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help=_OVERRIDE_HELP)
@json_option
def simulate(
    scene: str,
    explains: bool,
    views: int | None,
    out: Path | None,
    truth: Path | None,
    truth_bin: int | None,
    picture: Path | None,
    seed: int,
    overrides: tuple[str, ...],
    as_json: bool,
) -> None:
    """Simulate SCENE: a YAML file, or the name of a scene that comes with the package.

    Only the effects that the scene names are computed. The file has the format of the instrument, which
    `beamline recon` reads. A scene with `emission` gives the counts of a sample that emits (PET), which it reads, too.
    The first Ctrl-C stops after the current frame, with a readable file and its labels; the
    second stops at once.

    Exit code: 0 done, 2 wrong scene, 4 stopped, 5 disk error, 130 interrupted.
    """
    from beamline.simulate.scene_file import exposure_errors, open_emission, open_scene, scan_of
    from beamline.simulate.write import check_output

    clock = SystemClock()
    with terminated_like_interrupted(), json_events(as_json) as sink, exposure_errors(scene):
        if not (explains or out or truth or picture):
            raise ConfigError("Nothing to do. Give --explain, --out FILE, --truth FILE or --picture FILE.")
        if truth_bin and not truth:
            raise ConfigError("--truth-bin needs --truth FILE. Nothing was simulated.")
        if (emission := open_emission(scene, overrides)) is not None:
            if explains or truth_bin or picture:
                raise ConfigError(f"{scene} emits: it takes no --explain, --truth-bin or --picture. Leave them out.")
            refuse_shared({"--output": out, "--truth": truth})
            emission = replace(emission, lines=replace(emission.lines, views=views or emission.lines.views))
            output = _Output(sink, clock, plain=not as_json)
            output.event(Done(_emission(emission, seed, out, truth, output, sink)))
            return
        picture = out.with_suffix(".png") if out and not picture else picture
        _refuse_outputs(out, truth, picture)
        opened = open_scene(scene, overrides)
        scan = scan_of(opened, seed, views, clock.now())
        if out:
            check_output(scan, out)
        output = _Output(sink, clock, plain=not as_json)
        if explains:
            _explain(scan, output)
        outputs: dict[str, object] = {}
        if truth:
            outputs |= _truth(scan, truth, truth_bin, output)
        try:
            written = _scan(opened, scan, out, output, sink) if out else None
            if written:
                outputs |= {"output": written.path, "labels": written.labels, "n_frames": written.n_frames}
            if picture and not (written and written.stopped):
                marked = tuple((run.first + run.last) // 2 for run in written.runs) if written else ()
                from beamline.simulate.figure import sheet  # matplotlib takes a second

                write_whole(picture, sheet(scan, marked))
                outputs |= {"picture": picture}
                output("picture", str(picture))
        except Exception:
            if truth:
                remove(truth)
            raise
        if written and written.stopped:
            raise ScanStopped(
                f"Stopped after {written.n_frames} of {len(scan)} frames; {out} holds them and is readable."
            )
        output.event(Done(outputs))


def _refuse_outputs(out: Path | None, truth: Path | None, picture: Path | None) -> None:
    """Refuse output files that exist. Raises ConfigError: two outputs are the same file; DataError: one exists."""
    from beamline.simulate.labels import labels_path

    named = {"the scan": out, "its labels": out and labels_path(out), "the truth": truth, "the picture": picture}
    seen: dict[str, str] = {}
    for what, path in named.items():
        if path is None:
            continue
        other = seen.setdefault(os.path.realpath(path), what)
        if other is not what:
            raise ConfigError(f"{path} would be both {other} and {what}; name another. Nothing was simulated.")
        refuse_existing(path)


class _Output:
    """Prints results as lines, and sends them as events to programs."""

    def __init__(self, sink: Sink, clock: Clock, *, plain: bool) -> None:
        self._sink, self._clock, self._plain = sink, clock, plain

    def __call__(self, what: str, text: str) -> None:
        self.lines(f"{what:<10}{text}")

    def lines(self, text: str) -> None:
        if self._plain:
            click.echo(text)

    def event(self, event: Event) -> None:
        self._sink(replace(event, time=self._clock.now()))


def _explain(scan: Scan, output: _Output) -> None:
    from beamline.simulate.scene_file import cost_table, frame_cost

    found, where = frame_cost(scan, time.perf_counter), machine()
    costs = [asdict(cost) | {"domain": cost.domain and cost.domain.words} for cost in found.costs]
    output.event(CostExplained(asdict(found) | {"costs": costs, "machine": where}))
    output.lines(f"{machine_line(where)}\n\n{cost_table(found)}")


def _truth(scan: Scan, path: Path, binning: int | None, output: _Output) -> dict[str, object]:
    from beamline.simulate.truth import binning_of, memory_of, truth_of, write_truth

    n = binning or binning_of(scan.detector)
    try:
        needed, free = memory_of(scan.detector, n), free_memory()
    except ValueError as error:
        raise ConfigError(f"--truth-bin: {error}. Nothing was simulated.") from None
    if needed > free:
        raise ConfigError(
            f"--truth-bin {n}: the truth takes {size(needed)} of memory, {size(free)} are free. Give a larger "
            "--truth-bin. Nothing was simulated."
        )
    truth = truth_of(scan.scene.sample, scan.detector, n)
    write_truth(path, truth)
    voxels = " x ".join(map(str, truth.grid.shape))
    output("truth", f"{path}  {voxels} voxels of {truth.grid.voxel_size:.4g} mm, for `beamline recon --bin {n}`")
    return {"truth": path}


def _emission(
    scene: EmissionScene, seed: int, out: Path | None, truth: Path | None, output: _Output, sink: Sink
) -> dict[str, object]:
    from beamline.simulate.emission import emit, write_emission
    from beamline.simulate.truth import truth_of_emission, write_truth

    wanted = {"output": out, "truth": truth}
    for path in (path for path in wanted.values() if path):
        refuse_existing(path)
    with Terminal(sys.stderr) as terminal:
        made = emit(scene, seed, counting("views", fan_out(terminal, sink), SystemClock()))
    if truth:
        write_truth(truth, truth_of_emission(scene, made.scale))
        output("truth", f"{truth}  activity, {made.scale:.4g} counts per mm of line in the body")
    try:
        if out:
            write_emission(out, scene, made)
            output("scan", f"{out}  {len(made.counts)} views, {made.counts.sum():.4g} counts")
    except BaseException:  # Ctrl-C, too
        if truth:
            remove(truth)
        raise
    return {name: path for name, path in wanted.items() if path}


def _scan(scene: SceneFile, scan: Scan, out: Path, output: _Output, sink: Sink) -> SimulatedScan:
    from beamline.simulate.write import write_scan

    ending = StopOnSignal("Stopping after this frame. Ctrl-C again stops at once.")
    with ending() as stopped, Terminal(sys.stderr) as terminal:
        written = write_scan(scene, scan, out, fan_out(terminal, sink), SystemClock(), stopped)
    output("scan", f"{out}  {written.n_frames} frames, {written.seconds:.1f} s")
    events = ", ".join(f"{run.kind} in frames {run.first}-{run.last}" for run in written.runs)
    output("labels", f"{written.labels}  {events or 'no anomaly'}")
    return written
