"""`beamline simulate`: simulates the scan of a scene, and writes its frames, labels and ground truth."""

from __future__ import annotations

import itertools
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import WholeRange, json_events, with_request
from beamline.cli.terminal import Terminal
from beamline.core.errors import ConfigError, ScanStopped
from beamline.core.events import Done, Sink, StepsListed
from beamline.core.files import refuse_existing, remove, same_file, write_whole
from beamline.core.installed import shipped_scenes
from beamline.core.machine import free_memory
from beamline.core.sinks import fan_out
from beamline.core.stop import StopOnSignal, terminated_like_interrupted
from beamline.core.text import size
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.features.simulate.write import SimulatedScan
    from beamline.scenes.scene_file import SceneFile
    from simulators.scenes.expose import Scan

import inspect
from dataclasses import dataclass, replace

from beamline.cli.options import json_option, set_by
from beamline.core.events import Event
from drivers.base.clock import Clock
from simulators.effects.catalogue import CATALOGUE, load_effect


def effects_text() -> str:
    """Description of each effect that a scene can use, in the order of the physics: its parameters with defaults, the
    quantity that it changes, what happens, and the meaning of the parameters. This function imports all effects."""
    lines = []
    for name, row in sorted(CATALOGUE.items(), key=lambda item: item[1].domain):
        effect = load_effect(name)
        declared = inspect.signature(effect).parameters.values()
        parameters = ", ".join(str(each.replace(annotation=inspect.Parameter.empty)) for each in declared)
        _, _, meanings = (inspect.getdoc(effect) or "").partition("\nAttributes:\n")
        lines.append(f"{name}({parameters})  {row.domain.words}: {row.summary}\n{meanings}".strip())
    return "\n".join(lines)


_OVERRIDE_HELP = "Replace a value of the scene, for example detector.shape=[2048,2048]. Can be given several times."
_VIEWS = WholeRange(1)
_SEED = WholeRange(0, 2**63 - 1)
_FILE = click.Path(path_type=Path, dir_okay=False)


def _print_effects(ctx: click.Context, param: click.Parameter, wanted: bool) -> None:
    if wanted:
        click.echo(effects_text())
        ctx.exit()


@dataclass(frozen=True, eq=False)
class SimulateRequest:
    """The arguments of `beamline simulate`."""

    scene: str = set_by(click.argument("scene", metavar="SCENE"))
    explains: bool = set_by(
        click.option(
            "--effects",
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_effects,
            help="Print all effects that a scene can use, with their parameters, and stop.",
        ),
        "--explain",
        is_flag=True,
        help="Print the steps in which a frame is computed, in order.",
    )
    views: int | None = set_by(
        "--frames",
        type=_VIEWS,
        metavar="N",
        help="Number of projections over the range of angles of the scene. The speed of the stage stays as in the "
        "scene. Default: the number in the scene.",
    )
    out: Path | None = set_by(
        "-o",
        "--output",
        "--out",
        type=_FILE,
        help="Write the scan to this HDF5 file, and its labels to a file next to it.",
    )
    truth: Path | None = set_by(
        "--truth",
        type=_FILE,
        help="Write the ground truth to this HDF5 file: attenuation and label of each voxel of the sample.",
    )
    truth_bin: int | None = set_by(
        "--truth-bin",
        type=WholeRange(min=1),
        help=(
            "Voxel size of the ground truth in pixels. Use the same number as for --bin of the reconstruction that "
            "you want to compare. Default: the number with which the ground truth has about 256 voxels along each "
            "side."
        ),
    )
    picture: Path | None = set_by(
        "--picture", type=_FILE, help="Write a picture of some frames to this PNG file. Default: next to the scan file."
    )
    seed: int = set_by(
        "--seed", type=_SEED, metavar="N", default=0, show_default=True, help="Seed of all random numbers."
    )
    overrides: tuple[str, ...] = set_by("--set", multiple=True, metavar="KEY=VALUE", help=_OVERRIDE_HELP)
    as_json: bool = set_by(json_option)


class Output:
    """Prints results as lines for people, and also sends them as events for programs."""

    def __init__(self, sink: Sink, clock: Clock, *, plain: bool) -> None:
        self._sink, self._clock, self._plain = sink, clock, plain

    def __call__(self, what: str, text: str) -> None:
        self.lines(f"{what:<10}{text}")

    def lines(self, text: str) -> None:
        if self._plain:
            click.echo(text)

    def event(self, event: Event) -> None:
        self._sink(replace(event, time=self._clock.now()))


@click.command(epilog=f"Scenes that come with the package: {', '.join(shipped_scenes())}.")
@with_request(SimulateRequest)
def simulate(request: SimulateRequest) -> None:
    """Simulate the scan of a sample with known ground truth, and write it as a scan file.

    \b
    beamline simulate battery_noisy -o SCAN.h5 --truth TRUTH.h5
    beamline recon SCAN.h5 --truth TRUTH.h5
    beamline simulate battery_noisy --explain

    SCENE is a YAML file, or the name of a scene that comes with the package (listed below). Only the effects that the
    scene uses are computed. `beamline recon` reads the file as it reads a scan of the instrument. The first Ctrl-C
    stops after the current frame, and leaves a readable file with its labels; the second one stops at once.

    Exit code: 0 done, 2 wrong scene, 4 stopped, 5 disk error, 130 interrupted.
    """
    from beamline.features.simulate.write import check_output, exposure_errors, scan_of, sheet
    from beamline.scenes.scene_file import open_scene

    clock = SystemClock()
    with terminated_like_interrupted(), json_events(request.as_json) as sink, exposure_errors(request.scene):
        if not (request.explains or request.out or request.truth or request.picture):
            raise ConfigError("Nothing to do: add --explain, --output FILE, --truth FILE or --picture FILE.")
        if request.truth_bin and not request.truth:
            raise ConfigError("--truth-bin needs --truth FILE. Nothing was simulated.")
        picture = request.out.with_suffix(".png") if request.out and not request.picture else request.picture
        _refuse_outputs(request.out, request.truth, picture)
        opened = open_scene(request.scene, request.overrides)
        scan = scan_of(opened, request.seed, request.views, clock.now())
        if request.out:
            check_output(scan, request.out)
        output = Output(sink, clock, plain=not request.as_json)
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
                write_whole(picture, sheet(scan, marked))
                outputs |= {"picture": picture}
                output("picture", str(picture))
        except Exception:
            if request.truth:
                remove(request.truth)
            raise
        if written and written.stopped:
            raise ScanStopped(
                f"Stopped after {written.n_frames} of {len(scan)} frames. {request.out} has these frames and is "
                "readable."
            )
        output.event(Done(outputs))


def _refuse_outputs(out: Path | None, truth: Path | None, picture: Path | None) -> None:
    """Raise DataError for an output file that exists, and ConfigError if two outputs are the same file."""
    from beamline.simulate import labels_path

    named = {"the scan": out, "its labels": out and labels_path(out), "the truth": truth, "the picture": picture}
    given_paths = {what: path for what, path in named.items() if path is not None}
    for (what, first), (second_option, second) in itertools.combinations(given_paths.items(), 2):
        if same_file(first, second):
            raise ConfigError(
                f"{second} is given for {what} and for {second_option}: use two different files. Nothing was simulated."
            )
    for path in given_paths.values():
        refuse_existing(path)


def _explain(scan: Scan, output: Output) -> None:
    from beamline.features.simulate.write import steps_of, unused_effects

    steps, unused = steps_of(scan.scene), unused_effects(scan.scene)
    named = [dict(zip(("name", "domain", "summary"), step, strict=True)) for step in steps]
    output.event(StepsListed({"steps": named, "unused": unused}))
    output.lines(
        "\n".join(
            [f"{'step':<22}{'acts on':<15}what happens"]
            + [f"{name:<22}{domain:<15}{summary}" for name, domain, summary in steps]
            + ["\nEffects that the scene does not use (they are neither imported nor computed):"]
            + [f"  {name:<20}{summary}" for name, summary in unused]
        )
    )


def _truth(scan: Scan, path: Path, binning: int | None, output: Output) -> dict[str, object]:
    from beamline.scenes.scene_file import binning_of, memory_of, truth_of, write_truth

    n = binning or binning_of(scan.detector)
    try:
        needed, free = memory_of(scan.detector, n), free_memory()
    except ValueError as error:
        raise ConfigError(f"--truth-bin: {error}. Nothing was simulated.") from None
    if needed > free:
        raise ConfigError(
            f"Use a larger --truth-bin: with {n}, the ground truth needs {size(needed)} of memory, and {size(free)} is "
            "free. Nothing was simulated."
        )
    truth = truth_of(scan.scene.sample, scan.detector, n)
    write_truth(path, truth)
    voxels = " x ".join(map(str, truth.grid.shape))
    output(
        "truth",
        f"{path}  {voxels} voxels of {truth.grid.voxel_size:.4g} mm, as in volumes of `beamline recon --bin {n}`",
    )
    return {"truth": path}


def _scan(scene: SceneFile, scan: Scan, out: Path, output: Output, sink: Sink) -> SimulatedScan:
    from beamline.features.simulate.write import write_scan

    ending = StopOnSignal("Stopping after this frame. Press Ctrl-C again to stop at once.")
    with ending() as stopped, Terminal(sys.stderr) as terminal:
        written = write_scan(scene, scan, out, fan_out(terminal, sink), SystemClock(), stopped)
    output("scan", f"{out}  {written.n_frames} frames, {written.seconds:.1f} s")
    events = ", ".join(f"{run.kind} in frames {run.first}-{run.last}" for run in written.runs)
    output("labels", f"{written.labels}  {events or 'no anomaly'}")
    return written
