"""`beamline simulate`: frames of a scene without an instrument, their cost, their labels and the truth behind them."""

from __future__ import annotations

import os
import sys
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import json_events, json_option, refuse_shared, set_by, with_request
from beamline.cli.terminal import Terminal, counting
from beamline.core.errors import ConfigError, ScanStopped
from beamline.core.events import CostExplained, Done, Event, Sink
from beamline.core.files import refuse_existing, remove, write_whole
from beamline.core.machine import free_memory, machine, machine_line
from beamline.core.shipped import shipped_scenes
from beamline.core.sinks import fan_out
from beamline.core.stop import StopOnSignal, terminated_like_interrupted
from beamline.core.text import size
from drivers.base.clock import Clock, SystemClock

if TYPE_CHECKING:
    from beamline.simulate.scene_file import Scan, SceneFile
    from beamline.simulate.write import EmissionScene, SimulatedScan

_OVERRIDE_HELP = "Override a value of the scene, such as detector.shape=[2048,2048]. May be repeated."
_VIEWS = click.IntRange(1)
_SEED = click.IntRange(0, 2**63 - 1)
_FILE = click.Path(path_type=Path, dir_okay=False)


def _print_effects(ctx: click.Context, param: click.Parameter, wanted: bool) -> None:
    if wanted:
        from beamline.simulate.effect_table import effects_text  # here: help needs none of it

        click.echo(effects_text())
        ctx.exit()


@dataclass(frozen=True, eq=False)
class SimulateRequest:
    """What `beamline simulate` is asked for."""

    scene: str = set_by(click.argument("scene", metavar="SCENE"))
    explains: bool = set_by(
        click.option(
            "--effects",
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_effects,
            help="Print all effects that a scene may name, with their parameters, and end.",
        ),
        "--explain",
        is_flag=True,
        help="Print the steps of computing a frame, in order, with the time of each.",
    )
    views: int | None = set_by(
        "--frames",
        type=_VIEWS,
        metavar="N",
        help="Number of views over the scene's range, at the same speed of the stage. Default: as in the scene.",
    )
    out: Path | None = set_by(
        "-o", "--output", "--out", type=_FILE, help="Write the scan to this HDF5 file and its labels beside it."
    )
    truth: Path | None = set_by(
        "--truth", type=_FILE, help="Write the sample's attenuation and labels to this HDF5 file."
    )
    truth_bin: int | None = set_by(
        "--truth-bin",
        type=click.IntRange(min=1),
        help="Side of a voxel of the truth in pixels: the --bin of the reconstruction to compare. Default: for 256 "
        "voxels.",
    )
    picture: Path | None = set_by(
        "--picture", type=_FILE, help="Write some frames to this PNG file. Default: beside --out."
    )
    seed: int = set_by(
        "--seed", type=_SEED, metavar="N", default=0, show_default=True, help="Seed of all random numbers."
    )
    overrides: tuple[str, ...] = set_by("--set", multiple=True, metavar="KEY=VALUE", help=_OVERRIDE_HELP)
    as_json: bool = set_by(json_option)


@click.command(epilog=f"Scenes that come with the package: {', '.join(shipped_scenes())}.")
@with_request(SimulateRequest)
def simulate(request: SimulateRequest) -> None:
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
    with terminated_like_interrupted(), json_events(request.as_json) as sink, exposure_errors(request.scene):
        if not (request.explains or request.out or request.truth or request.picture):
            raise ConfigError("Nothing to do. Give --explain, --out FILE, --truth FILE or --picture FILE.")
        if request.truth_bin and not request.truth:
            raise ConfigError("--truth-bin needs --truth FILE. Nothing was simulated.")
        if (emission := open_emission(request.scene, request.overrides)) is not None:
            if request.explains or request.truth_bin or request.picture:
                raise ConfigError(
                    f"{request.scene} emits: it takes no --explain, --truth-bin or --picture. Leave them out."
                )
            refuse_shared({"--output": request.out, "--truth": request.truth})
            emission = replace(emission, lines=replace(emission.lines, views=request.views or emission.lines.views))
            output = _Output(sink, clock, plain=not request.as_json)
            output.event(Done(_emission(emission, request.seed, request.out, request.truth, output, sink)))
            return
        picture = request.out.with_suffix(".png") if request.out and not request.picture else request.picture
        _refuse_outputs(request.out, request.truth, picture)
        opened = open_scene(request.scene, request.overrides)
        scan = scan_of(opened, request.seed, request.views, clock.now())
        if request.out:
            check_output(scan, request.out)
        output = _Output(sink, clock, plain=not request.as_json)
        if request.explains:
            _explain(scan, output)
        outputs: dict[str, object] = {}
        if request.truth:
            outputs |= _truth(scan, request.truth, request.truth_bin, output)
        try:
            written = _scan(opened, scan, request.out, output, sink) if request.out else None
            if written:
                outputs |= {"output": written.path, "labels": written.labels, "n_frames": written.n_frames}
            if picture and not (written and written.stopped):
                marked = tuple((run.first + run.last) // 2 for run in written.runs) if written else ()
                from beamline.simulate.figure import sheet  # matplotlib takes a second

                write_whole(picture, sheet(scan, marked))
                outputs |= {"picture": picture}
                output("picture", str(picture))
        except Exception:
            if request.truth:
                remove(request.truth)
            raise
        if written and written.stopped:
            raise ScanStopped(
                f"Stopped after {written.n_frames} of {len(scan)} frames; {request.out} holds them and is readable."
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

    cost_of_frame, where = frame_cost(scan, time.perf_counter), machine()
    costs = [asdict(cost) | {"domain": cost.domain and cost.domain.words} for cost in cost_of_frame.costs]
    output.event(CostExplained(asdict(cost_of_frame) | {"costs": costs, "machine": where}))
    output.lines(f"{machine_line(where)}\n\n{cost_table(cost_of_frame)}")


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
    from beamline.simulate.truth import truth_of_emission, write_truth
    from beamline.simulate.write import emit, write_emission

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
