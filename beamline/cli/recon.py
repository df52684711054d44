"""`beamline recon`: reconstructs a scan file; writes a volume and its report."""

from __future__ import annotations

import re
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.log import LogLines, logged
from beamline.cli.method_options import (
    SETTINGS,
    method_options,
    method_with,
    options_of_a_method,
    preset_of,
    preset_option,
    refuse_contradictions,
    resumes_slabs,
)
from beamline.cli.option_groups import DATA, METHOD, OUTPUT, RESOURCES, Grouped, heading
from beamline.cli.options import (
    NOT_NEGATIVE,
    POSITIVE,
    SEED,
    json_events,
    json_option,
    parsed,
    refuse_shared,
    scan_argument,
    volume_path,
)
from beamline.cli.recipe import config_option, recipe_text, repeating
from beamline.cli.recon_time import recon_series, refuse_others, time_options
from beamline.cli.selection_options import chosen, selection_options, steps_said
from beamline.cli.terminal import counting, events_shown, results
from beamline.core.errors import DataError, QualityError, ScanStopped
from beamline.core.events import Done, Event, FitReached, StateEntered, VolumeDone
from beamline.core.files import write_whole
from beamline.core.process import EndsWithParent
from beamline.core.signals import StopOnSignal
from beamline.core.sinks import fan_out
from beamline.storage.volumes.registry import suffixes_text
from drivers.base.clock import Clock, SystemClock
from recon.base.choices import AUTO, Filter, Quality
from recon.methods import DEFAULT, names

if TYPE_CHECKING:
    from beamline.reconstruct.axis_trials import AxisRange
    from beamline.reconstruct.options import ReconOptions
    from beamline.reconstruct.region import Region


def output_path(text: str) -> Path:
    """The path of a volume, or of the picture of --axis try. ValueError for another suffix."""
    return Path(text) if Path(text).suffix.lower() == _SHEET else volume_path(text)


def memory_size(text: str) -> int:
    """Bytes of a size such as 8G, 500M or 1.5GB (decimal units). ValueError for anything else."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([KMGT])B?", text.strip(), re.IGNORECASE)
    if match is None or not float(match[1]) > 0:
        raise ValueError(f"{text!r} is no size; expected a number and K, M, G or T, such as 8G")
    return round(float(match[1]) * 1000 ** (" KMGT".index(match[2].upper())))


def cluster_of(text: str) -> str:
    """Workers, `local:N`, an address or `slurm:CONFIG`. ValueError for anything else."""
    from beamline.reconstruct.cluster import check_cluster  # here: help needs none of it

    check_cluster(text)
    return text


def region_of(text: str) -> Region:
    """A box of voxels, `z0:z1,y0:y1,x0:x1`. ValueError for anything else."""
    from beamline.reconstruct.region import Region  # here: help needs none of it

    return Region.parse(text)


_SHEET = ".png"


@click.command(
    cls=Grouped, first=("method", "views", "rows", "binning", "axis", "rings", "budget", "output", "follow", "dry")
)
@heading(DATA)
@config_option
@scan_argument
@heading(METHOD)
@click.option(
    "-m",
    "--method",
    type=click.Choice((AUTO, *names())),
    help="auto chooses r2, fista-tv or fbp by how well it predicts views held out. r2 fits Gaussians to the views, "
    "fbp is filtered back-projection, the others iterate on voxels. Default: auto; r2 with --follow and with "
    "options of the fit.",
)
@selection_options
@method_options
@preset_option
@time_options
@heading(METHOD)
@click.option(
    "--filter",
    "ramp",
    type=click.Choice(["ram-lak", "shepp-logan", "hann"]),
    default="hann",
    show_default=True,
    help="Filter of fbp, also of the fbp for comparison with r2. hann is best for few or noisy views.",
)
@heading(OUTPUT)
@click.option(
    "--max-residual",
    type=NOT_NEGATIVE,
    metavar="X",
    help="Exit with code 6 if the data residual (of views held out, if there are any) is larger.",
)
@heading(METHOD)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Seed of all random numbers.")
@heading(OUTPUT)
@click.option(
    "--uncertainty",
    is_flag=True,
    help="Write the standard deviation of each voxel, too, from two refits of halves of the views; by r2, fista-tv and "
    "fbp, into an .h5.",
)
@click.option(
    "--truth", metavar="FILE[:A:B]", help="Volume to compare with (.npz, .npy, HDF5); A:B are its slices to use."
)
@click.option(
    "-o",
    "--output",
    metavar="PATH",
    callback=parsed(output_path),
    help=f"Output: {suffixes_text()}; of --axis try a .png. "
    "Default: FILE's stem + _METHOD.h5 (_axis.png), in this folder.",
)
@click.option(
    "--report/--no-report",
    default=True,
    show_default=True,
    help="Write an HTML page beside the output; a browser prints it on A4, also as PDF.",
)
@heading(DATA)
@click.option("--follow", is_flag=True, help="Follow a running scan: reconstruct while its file grows.")
@click.option(
    "--earlier",
    type=click.Path(path_type=Path),
    multiple=True,
    metavar="FILE",
    help="With --follow, of a run that goes on: an earlier part of it, whose views come first. May be repeated.",
)
@click.option(
    "--enough-loss",
    type=POSITIVE,
    metavar="DB",
    help="With --follow: say when the views to come would add at most so many dB of PSNR.",
)
@click.option(
    "--enough-gain",
    type=POSITIVE,
    metavar="DB",
    help="With --follow: say when ten more views would add at most so many.",
)
@click.option(
    "--unfinished", is_flag=True, help="Accept an unfinished scan, one that failed or still runs, and use its frames."
)
@heading(RESOURCES)
@click.option(
    "--memory",
    metavar="SIZE",
    callback=parsed(memory_size),
    help="Memory to use, such as 8G or 500M: a larger scan of a parallel beam lies on the disk of the output "
    "meanwhile, and is reconstructed slab by slab. Default: 70 % of what is free, within a container's limit.",
)
@click.option(
    "--cluster",
    metavar="local:N|tcp://HOST:PORT|slurm[:CONFIG]",
    callback=parsed(cluster_of),
    help="Workers of dask.distributed that reconstruct slabs, where a volume is made in slabs: N on this machine, "
    "those of a scheduler, or jobs of Slurm by a YAML file.",
)
@heading(OUTPUT)
@click.option(
    "--roi",
    metavar="Z0:Z1,Y0:Y1,X0:X1",
    callback=parsed(region_of),
    help="Box of voxels to write, of the volume that the same options give without this one. It is made of the rows "
    "that show it; fbp makes these voxels alone.",
)
@click.option(
    "--write-config",
    type=click.Path(path_type=Path),
    help="Write the options of this call as a recipe to this file (-: print it). Without -o that is all that is done.",
)
@click.option("--log", type=click.Path(path_type=Path), help="Write everything that happens to this text file.")
@click.option("-v", "--verbose", is_flag=True, help="Print everything that happens, with its time, to stderr.")
@heading(RESOURCES)
@click.option(
    "--dry-run",
    "dry",
    is_flag=True,
    help="Print the memory, time and disk space that it will take, by small runs of a few seconds, and end.",
)
@click.option("--beside-scan", "beside", is_flag=True, hidden=True, help="Ends with its scan; its output is the run's.")
@heading(OUTPUT)
@json_option
def recon(
    file: Path,
    method: str | None,
    preset: str | None,
    any_setting: dict[str, Any],
    budget: float | None,
    quality: Quality | None,
    device: str,
    checkpoint: Path | None,
    resume: Path | None,
    ramp: Filter,
    max_residual: float | None,
    seed: int,
    uncertainty: bool,
    truth: str | None,
    output: Path | None,
    report: bool,
    follow: bool,
    earlier: tuple[Path, ...],
    enough_loss: float | None,
    enough_gain: float | None,
    unfinished: bool,
    memory: int | None,
    cluster: str | None,
    roi: Region | None,
    dry: bool,
    write_config: Path | None,
    log: Path | None,
    verbose: bool,
    as_json: bool,
    beside: bool,
    volumes: int | None,
    moves: bool | None,
    **values: Any,
) -> None:
    """Reconstruct the scan in FILE: HDF5, multi-page TIFF, folder or .zip of TIFFs, .txrm.

    HDF5 is NXtomo, Diamond NeXus, Data Exchange, or any layout whose datasets --data-path and its like name.

    Writes a volume [z, y, x] in 1/mm (1/px if the pixel size is unknown), by default as NXtomoproc with all settings,
    and a report. Nothing is overwritten, and a failure leaves no partial file. From the first step or iteration on,
    the first Ctrl-C stops with the volume reached so far (exit code 4), the second discards it. A volume in slabs
    keeps those that are finished, also where it is killed, in OUTPUT.partial.h5; --resume goes on from there.

    --time N fits a sample that changes while it is scanned: N volumes in time, which `beamline view` plays.
    """
    from beamline.reconstruct.checkpoints import CheckpointOptions  # here: help needs none of it
    from beamline.reconstruct.follow import follow as follow_scan
    from beamline.reconstruct.offline import reconstruct_file
    from beamline.reconstruct.options import ReconOptions
    from beamline.reconstruct.output_paths import OutputPaths, report_beside
    from recon.voxels.enough_views import Goal

    settings = {name: values.pop(name) for name in SETTINGS}
    context = click.get_current_context()
    if volumes is not None:
        refuse_others(context, values)
        refuse_shared({"FILE": file, "--output": output})
        source, selection = chosen(file, seed, values)
        target = output or Path(f"{file.stem}_time.h5")
        for_series = ReconOptions(
            source, OutputPaths(target, report_beside(target) if report else None), selection, seed=seed,
            unfinished=unfinished, memory=memory, command=repeating(context, file, target),
        )  # fmt: skip
        recon_series(for_series, volumes, moves, dry, as_json)
        return
    if moves is not None:
        raise click.UsageError("--moves and --no-moves are of volumes in time: give --time N with them.")
    method = preset_of(method, preset)
    if method is None:
        method = DEFAULT if follow or any_setting or set(options_of_a_method(context)) - {"budget"} else AUTO
    refuse_contradictions(context, method, follow)
    for step in steps_said(values) if follow else ():
        if step.needs_finished:
            raise click.UsageError(step.needs_finished)
    enough = None if enough_loss is enough_gain is None else Goal(enough_gain, enough_loss)
    partial = resume if resumes_slabs(resume) else None
    typed, output = output, output or Path(f"{file.stem}_{method}.h5")
    page = report_beside(output) if report else None
    files = {"FILE": file, "--output": output, "report": page, "--checkpoint": checkpoint}
    refuse_shared({**files, "--resume": resume, "--log": log, "--write-config": write_config})
    tried = None if values["axis"] is None or isinstance(values["axis"], float) else values["axis"]
    whole, tries = follow or budget is not None, tried is not None
    for refused, why in (
        (enough and not follow, "--enough-loss and --enough-gain are for a scan that still runs: give --follow."),
        (memory and whole, "--memory does not go with --follow or --budget, which hold everything in memory."),
        (partial and follow, f"--resume {resume} holds slabs of a finished scan; it does not go with --follow."),
        (dry and whole, "--dry-run does not go with --follow or --budget, which says the time itself."),
        (cluster and whole, "--cluster does not go with --follow or --budget, which hold everything in memory."),
        (
            uncertainty and (whole or tries or settings["seconds"] is not None),
            "--uncertainty does not go with --follow, --budget, --seconds or --axis try: refits need the whole scan "
            "and time of their own.",
        ),
        (roi and (follow or truth or tries), "--roi does not go with --follow, --truth or --axis try."),
        (tries and follow, "--axis try is for a finished scan: it needs all views."),
        (tries and (dry or log), "--axis try does not go with --dry-run or --log: it writes a picture of slices only."),
        (earlier and not follow, "--earlier is for a run that goes on: give --follow, or the joined.h5 of its parts."),
    ):
        if refused:
            raise click.UsageError(why)
    if typed is not None and (typed.suffix.lower() == _SHEET) != tries:
        what, suffix = ("--axis try writes a picture", _SHEET) if tries else ("only --axis try writes a picture", ".h5")
        raise click.UsageError(f"-o {typed}: {what}; give a name such as {typed.with_suffix(suffix)}.")
    source, selection = chosen(file, seed, values if tried is None else values | {"axis": None})
    options = ReconOptions(
        source=replace(source, earlier=earlier),
        target=OutputPaths(output, page),
        selection=selection,
        method=method_with(method, {**settings, "filter": ramp, "any_setting": any_setting}),
        budget=budget,
        quality=quality,
        checkpoints=CheckpointOptions(checkpoint, None if partial else resume),
        device=device,
        filter=ramp,
        seed=seed,
        truth=truth,
        unfinished=unfinished,
        enough=enough,
        memory=memory,
        region=roi,
        cluster=cluster,
        partial=partial,
        uncertainty=uncertainty,
        command=repeating(context, file, output, () if partial is None else ("resume",)),
        recipe=recipe_text(context, method),
    )
    if roi is not None and max_residual is not None and options.method.traits.direct:
        raise click.UsageError("--max-residual needs the whole volume; fbp with --roi makes only the box.")
    if write_config is not None:
        if typed is not None:
            options.target.refuse_existing()
        _write_recipe(write_config, options.recipe)
        if typed is None:
            return
    clock = SystemClock()
    if tried is not None:
        _try_axes(options, tried, typed or Path(f"{file.stem}_axis{_SHEET}"), as_json)
        return
    if dry:
        _dry_run(options, clock, as_json)
        return
    last: list[Event] = []
    stop = StopOnSignal(ready=follow or budget is not None)

    def made(event: Event) -> None:
        """From the first step or iteration on there is a volume; what has a unit is a trial, or slices."""
        of_bars = isinstance(event, StateEntered) and event.state == "error_bars"
        if of_bars or (isinstance(event, FitReached) and not event.unit):
            stop.ready = True

    with events_shown(as_json) as usual:
        shown = LogLines(sys.stderr, terminal=True) if verbose and not as_json else usual
        with logged(log, shown) as lines:
            sink = fan_out(last.append, made, *lines, shown)
            scope = EndsWithParent(stop, sys.stdin.fileno()) if beside else stop
            metrics = (follow_scan if follow else reconstruct_file)(options, sink, clock, stop_scope=scope)
    done = last[-1]
    assert isinstance(done, VolumeDone)
    if not as_json:
        click.echo(results(done.record))
    if lost := done.record.parameters.get("checkpoint_lost"):
        raise DataError(f"The last checkpoint was left out: {lost} The volume is in {output}.")
    if done.record.ended_early:
        raise ScanStopped(f"The reconstruction was stopped early; {output} holds the volume reached by then.")
    if max_residual is not None:
        require(metrics, max_residual)


def require(metrics: Mapping[str, float], max_residual: float) -> None:
    """Raises QualityError if the data residual of a finished volume exceeds the limit."""
    name = "residual_held_out" if "residual_held_out" in metrics else "residual"
    if not metrics[name] <= max_residual:
        views = "held out" if name == "residual_held_out" else "used"
        raise QualityError(
            f"The data residual of views {views} is {metrics[name]:.4g}, more than --max-residual {max_residual:g}. "
            "The volume and its report were written. Check them, the rotation axis and the flags of the scan."
        )


def _dry_run(options: ReconOptions, clock: Clock, as_json: bool) -> None:
    """Print the time, memory and disk space of a reconstruction."""
    from beamline.reconstruct.estimate import estimate

    with json_events(as_json) as sink:
        found = estimate(options, clock)
        sink(Done(found, time=clock.now()))
    if not as_json:
        click.echo("\n".join(found.lines()))


def _try_axes(options: ReconOptions, wanted: AxisRange, path: Path, as_json: bool) -> None:
    """Write a picture of one slice by each of some axes."""
    from beamline.reconstruct.axis_trials import try_axes

    last: list[Event] = []
    with events_shown(as_json) as shown:
        sink, clock = fan_out(last.append, shown), SystemClock()
        try_axes(options, wanted, path, sink, clock, counting("axes", sink, clock))
    if not as_json:
        done = last[-1].data
        scores = "\n".join(f"  {col:>8}  {score:.4f}" for col, score in done["scores"].items())
        click.echo(f"axis    share below 0 (lower is better)\n{scores}\nbest    {done['axis_col']:g}\nsheet   {path}")
        click.echo(f"If the picture agrees: beamline recon {options.source.path} --axis {done['axis_col']:g}", err=True)


def _write_recipe(path: Path, text: str) -> None:
    if str(path) == "-":
        click.echo(text, nl=False)
    else:
        write_whole(path, text)
