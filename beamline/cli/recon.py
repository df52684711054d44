"""`beamline recon`: a scan file in, a volume and its report out."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import click

from beamline.cli.narrate import results
from beamline.cli.selection_options import chosen, selection_options
from beamline.cli.told import EndOfFit, terminated_like_interrupted, told_as_json
from beamline.deliver import Target
from beamline.errors import QualityError, ScanStopped
from beamline.events import Event, fan_out
from beamline.follow import follow as follow_scan
from beamline.offline import ReconOptions, run
from beamline.terminal import Terminal
from drivers.clock import SystemClock
from recon.fbp import Filter
from recon.quality import PRESETS, Quality, parse_budget
from recon.reconstruction import Method


def time_given(ctx: click.Context, param: click.Parameter, value: str | None) -> float | None:
    """A time such as 30s, 2m or 1h, in s."""
    if value is None:
        return None
    try:
        return parse_budget(value)
    except ValueError as error:
        raise click.BadParameter(str(error)) from error


def whole_output(ctx: click.Context, param: click.Parameter, value: Path | None) -> Path | None:
    """A file that can be told from its report."""
    if value is not None and (not value.name or value.suffix.lower() in (".html", ".htm")):
        raise click.BadParameter(f"{str(value)!r} cannot hold a volume; name an HDF5 file, such as volume.h5")
    return value


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "-m",
    "--method",
    type=click.Choice(get_args(Method)),
    default="r2",
    show_default=True,
    help="r2: Gaussians fitted to the views; fbp: filtered back-projection.",
)
@selection_options
@click.option("--steps", type=click.IntRange(min=1), help="Steps of the fit (r2).")
@click.option(
    "--seconds",
    type=click.FloatRange(min=0, min_open=True),
    help="Time for the fit (r2), instead of --steps; with --follow, after the scan has ended.",
)
@click.option(
    "--budget",
    callback=time_given,
    metavar="30s|2m|1h",
    help="Time from line integrals to volume; chooses method, Gaussians, steps and binning, and ends in time.",
)
@click.option(
    "--quality",
    type=click.Choice(list(PRESETS)),
    help="A preset of steps and Gaussians, instead of naming them.",
)
@click.option("--gaussians", type=click.IntRange(min=1), help="How many to start from (r2).")
@click.option(
    "--filter",
    "ramp",
    type=click.Choice(["ram-lak", "shepp-logan", "hann"]),
    default="hann",
    show_default=True,
    help="Of the fbp, also of the one that r2 is compared with. hann is best for few or noisy views.",
)
@click.option(
    "--max-residual",
    type=click.FloatRange(min=0),
    metavar="X",
    help="Exit with code 6 where the data residual (of views held out, if there are any) is larger.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of everything random.")
@click.option("--truth", metavar="FILE[:A:B]", help="Volume to compare with (.npz, .npy, HDF5), slices A to B.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, dir_okay=False),
    callback=whole_output,
    help="Default: FILE's stem + _METHOD.h5, here.",
)
@click.option("--report/--no-report", default=True, show_default=True, help="An HTML page beside the output.")
@click.option("--follow", is_flag=True, help="The scan is still running: reconstruct while its file grows.")
@click.option("--unfinished", is_flag=True, help="Take the frames there are, of a scan that died or still runs.")
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def recon(
    file: Path,
    method: Method,
    steps: int | None,
    seconds: float | None,
    budget: float | None,
    quality: Quality | None,
    gaussians: int | None,
    ramp: Filter,
    max_residual: float | None,
    seed: int,
    truth: str | None,
    output: Path | None,
    report: bool,
    follow: bool,
    unfinished: bool,
    as_json: bool,
    **said: Any,
) -> None:
    """Reconstruct the scan in FILE: NXtomo, Diamond NeXus, Data Exchange, multi-page TIFF, folder or .zip of TIFFs.

    Writes a volume [z, y, x] in 1/mm (1/px where the pixel size is unknown) as NXtomoproc, with everything that it was
    made with, and a report. Nothing is overwritten, and a failure leaves nothing behind. Ctrl-C during the fit ends it
    with the volume as it is (exit code 4), a second one without.
    """
    if steps is not None and seconds is not None:
        raise click.UsageError("--steps and --seconds exclude each other: say how long the fit may take in one way.")
    if method != "r2" and any(value is not None for value in (steps, seconds, gaussians)):
        raise click.UsageError(f"--steps, --seconds and --gaussians are of the r2 fit; {method} has none.")
    refuse_contradictions(method, follow, {"--budget": budget, "--quality": quality}, steps, seconds, gaussians)
    output = output or Path(f"{file.stem}_{method}.h5")
    source, selection = chosen(file, seed, said)
    options = ReconOptions(
        source=source,
        target=Target(output, report_beside(output) if report else None),
        selection=selection,
        method=method,
        steps=steps,
        seconds=seconds,
        budget=budget,
        quality=quality,
        gaussians=gaussians,
        filter=ramp,
        seed=seed,
        truth=truth,
        unfinished=unfinished,
        command=repeated(sys.argv[1:]),
    )
    clock, end = SystemClock(), EndOfFit()
    last: list[Event] = []
    with terminated_like_interrupted(), told_as_json(as_json) as json_sinks, Terminal(sys.stderr) as terminal:
        sink = fan_out(last.append, *(json_sinks or [terminal]))
        metrics = (follow_scan if follow else run)(options, sink, clock, stoppable=end)
    if not as_json:
        click.echo(results(last[-1].data))
    if end.asked:
        raise ScanStopped(f"The fit was ended early; {output} holds the volume as it then was.")
    if max_residual is not None:
        require(metrics, max_residual)


def refuse_contradictions(
    method: str,
    follow: bool,
    plans: Mapping[str, object | None],
    steps: int | None,
    seconds: float | None,
    gaussians: int | None,
) -> None:
    """Raises UsageError where `plans` (--budget, --quality) would choose what was also given."""
    wanted = [name for name, value in plans.items() if value is not None]
    if not wanted:
        return
    given = {"--steps": steps, "--seconds": seconds, "--gaussians": gaussians}
    others = [*wanted[1:], *(name for name, value in given.items() if value is not None)]
    if others:
        raise click.UsageError(
            f"{wanted[0]} and {others[0]} exclude each other: {wanted[0]} chooses what the other says."
        )
    if method != "r2":
        raise click.UsageError(f"{wanted[0]} chooses settings of the r2 fit; it does not go with --method {method}.")
    if follow:
        raise click.UsageError(f"{wanted[0]} is for a finished scan; with --follow give --seconds.")


def require(metrics: Mapping[str, float], max_residual: float) -> None:
    """Raises QualityError where a finished volume explains the data less well than asked for."""
    name = "residual_held_out" if "residual_held_out" in metrics else "residual"
    if not metrics[name] <= max_residual:
        views = "held out" if name == "residual_held_out" else "used"
        raise QualityError(
            f"The data residual of views {views} is {metrics[name]:.4g}, more than --max-residual {max_residual:g}. "
            "The volume and its report were written; look at them, at the axis, and at the flags of the scan."
        )


def report_beside(output: Path) -> Path:
    """A run's recon.h5 has report.html; any other output a page of its own name: several fit in a folder."""
    return output.with_name("report.html") if output.stem == "recon" else output.with_suffix(".html")


def repeated(arguments: list[str]) -> str:
    """The command line that repeats this call."""
    return shlex.join(["beamline", *arguments])
