"""`beamline recon`: reconstructs a scan, and writes the volume and a report."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.method_options import (
    method_with,
    refuse_other_methods,
    settings_of,
    slabs_resumed,
)
from beamline.cli.options import declared, json_events, refuse_contradictions, refuse_shared
from beamline.cli.recipe import Grouped, names_given, recipe_text, typed_line
from beamline.cli.recon_options import recon_options
from beamline.cli.selection_options import chosen, chosen_steps
from beamline.cli.terminal import events_shown, results
from beamline.core.errors import DataError, QualityError, ScanStopped
from beamline.core.events import Done, Event, StateEntered
from beamline.core.files import write_whole
from beamline.core.process import EndsWithParent
from beamline.core.recon_events import FitReached
from beamline.core.sinks import fan_out
from beamline.core.stop import StopOnSignal
from beamline.core.text import safe_name
from beamline.reconstruct.combinations import SLABS_RESUMED
from drivers.base.clock import Clock, SystemClock
from recon.base.choices import AUTO
from recon.methods import DEFAULT, IN_TIME, WITH_REFERENCE, streams

if TYPE_CHECKING:
    from beamline.reconstruct.options import ReconOptions
    from beamline.storage.recon_record import ReconRecord


@click.command(
    cls=Grouped, first=("method", "views", "rows", "binning", "axis", "rings", "budget", "output", "follow", "dry")
)
@recon_options
def recon(**values: Any) -> None:
    """Reconstruct the scan in FILE, and write a volume and a report.

    \b
    beamline recon SCAN.h5                          the method is chosen for you
    beamline recon SCAN.h5 -m fbp --rows 500:510    a first look at ten slices
    beamline recon SCAN.h5 -m fista-tv --bin 2      binned 2 x 2, quicker

    FILE is HDF5, multi-page TIFF, a folder or .zip of images, .npy, Zarr or .txrm. Known HDF5 layouts are NXtomo,
    Diamond NeXus and Data Exchange; for any other layout name the datasets with --data-path, --angles-path,
    --flats-path and --darks-path.

    The volume [z, y, x] is in 1/mm (1/px if the pixel size is unknown). By default it is an NXtomoproc file, which
    also holds all settings. No file is overwritten, and a failure leaves no partial file.

    The first Ctrl-C stops and keeps the volume reached so far (exit code 4), if at least one step or iteration is done;
    the second one discards it. Finished slabs of a large volume stay in OUTPUT.partial.h5, even if the process is
    killed; --resume continues from this file.

    If the sample changes during the scan, --volumes N reconstructs N volumes at successive times, and `beamline view`
    plays them as a film.
    """
    there = not values["follow"] and values["write_config"] is None  # a recipe can be written without a scan
    options = options_of(click.get_current_context(), there=there)
    if values["write_config"] is not None:
        if values["output"] is not None:
            options.target.refuse_existing()
        _write_recipe(values["write_config"], options.recipe)
        if values["output"] is None:
            return
    if values["dry"]:
        dry_run(options, SystemClock(), values["as_json"])
    else:
        run_reconstruction(options, values)


def options_of(context: click.Context, default: str = "", *, there: bool = False) -> ReconOptions:
    """The options of a reconstruction, from the parameters of a click context of `recon`.

    Args:
        default: the method if the user names none; empty: the usual method for the given options. there: True if the
            scan must exist. This is checked before the numerical libraries are loaded.

    Raises:
        UsageError: options exclude each other, a file is named twice, or the method cannot do what is asked.
        DataError: the scan does not exist.
    """
    values, file = dict(context.params), context.params["file"]
    method = _checked_method(context, default)
    path = values["output"] or Path(f"{safe_name(file.stem)}_{method}.h5")
    for option, needed in (("", file), ("--reference ", values["reference"])) if there else ():
        if needed is not None and not needed.exists():
            with json_events(values["as_json"]):
                raise DataError(f"{option}{needed} does not exist.")
    from beamline.reconstruct.checkpoints import CheckpointOptions  # imported here because help does not need it
    from beamline.reconstruct.options import FollowTiming, OutputPaths, ReconOptions, report_beside

    page = report_beside(path) if values["report"] else None
    files = {"FILE": file, "--output": path, "report": page, "--checkpoint": values["checkpoint"]}
    files |= {"--resume": values["resume"], "--write-config": values["write_config"]}
    refuse_shared(files | {"--reference": values["reference"]})
    partial = slabs_resumed(values["resume"])
    source, selection = chosen(file, values["seed"], values)
    settings = settings_of(context.command, dict(values)) | {"filter": values["filter"]}
    built = method_with(method, settings, values["any_setting"])
    if values["region"] is not None and values["max_residual"] is not None and built.makes_boxes:
        raise click.UsageError(
            "--max-residual needs the whole volume, but fbp with --roi computes only the box. Leave out one of the two "
            "options."
        )
    same = {each.name: values[each.name] for each in fields(ReconOptions) if each.name in values}
    return ReconOptions(**same | {
        "source": source, "target": OutputPaths(path, page), "selection": selection, "method": built,
        "checkpoints": CheckpointOptions(values["checkpoint"], None if partial else values["resume"]),
        "follow": FollowTiming() if values["follow"] else None, "partial": partial,
        "recipe": recipe_text(context, method), "command": typed_line(context),
    })  # fmt: skip


def _checked_method(context: click.Context, default: str = "") -> str:
    """The name of the method, after a check that all options can be combined with each other and with the method.

    Args:
        default: the method if the user names none; empty: the usual method for the given options.

    Raises: UsageError: the options cannot be combined.
    """
    given_names, values = names_given(context), context.params
    if slabs_resumed(values["resume"]):
        given_names = given_names - {"resume"} | {SLABS_RESUMED}
    method = values["method"]
    if "reference" in given_names and method in (None, AUTO):
        method = WITH_REFERENCE
    if method is not None and method == WITH_REFERENCE and "reference" not in given_names:
        raise click.UsageError(
            f"--method {method} needs --reference GOOD: an earlier volume of the same sample, or its scan."
        )
    stated = method is not None
    if method is None:
        of_a_method = {name for name, param in declared(context.command).items() if param.setting or param.argument}
        of_fits = values["follow"] or values["any_setting"] or (of_a_method & given_names) - {"budget", "quality"}
        method = default or (_in_time() if "volumes" in given_names else DEFAULT if of_fits else AUTO)
    refuse_contradictions(context.command, given_names, {SLABS_RESUMED: f"--resume {values['resume']}"})
    refuse_other_methods(context, given_names, method, stated=stated)
    for step in chosen_steps(values) if values["follow"] and streams(method) else ():
        if step.needs_finished:
            raise click.UsageError(step.needs_finished)
    return method


def _in_time() -> str:
    if IN_TIME is None:
        raise click.UsageError("--volumes: this installation cannot reconstruct a time series. Leave out --volumes.")
    return IN_TIME


def refuse_recipe(config: Path) -> None:
    """Raise UsageError if options of a recipe exclude each other or do not belong to its method. The scan plays no
    role. The error is shown as an error of the command that calls this function.
    """
    try:
        with recon.make_context("beamline recon", ["SCAN", "--config", str(config)]) as context:
            values = dict(context.params)
            method_with(_checked_method(context), settings_of(recon, values), values["any_setting"])
    except click.UsageError as error:
        error.ctx = click.get_current_context()
        raise


def run_reconstruction(
    options: ReconOptions, values: Mapping[str, Any], more: Callable[[ReconRecord], Sequence[str]] = lambda record: ()
) -> None:
    """Write the volume and its report, with progress on the terminal.

    Args:
        values: parameters of the command; a parameter that is missing counts as not given.
        more: function that returns further lines to print after the result.

    Raises:
        ScanStopped: the reconstruction was stopped early; the volume was written.
        DataError: the volume was written, but not the last checkpoint.
        QualityError: the volume was written, but its residual is above the limit.
    """
    from beamline.reconstruct.pipeline import reconstruct_file  # imported here because help does not need it

    limit = values.get("max_residual")
    stop = StopOnSignal(ready=options.follow is not None)

    def count_event(event: Event) -> None:
        """Record when the first volume exists, so that Ctrl-C can keep it.

        The first volume exists from the first step or iteration of the method itself. (Events of test reconstructions
        and of slices have a unit.) If several volumes are reconstructed, they exist from the first test reconstruction
        on.
        """
        of_bars = isinstance(event, StateEntered) and event.state == "error_bars"
        if of_bars or (isinstance(event, FitReached) and (not event.unit or options.method.volumes > 1)):
            stop.ready = True

    with events_shown(values["as_json"]) as shown:
        scope = EndsWithParent(stop, sys.stdin.fileno()) if values.get("beside") else stop
        record = reconstruct_file(options, fan_out(count_event, shown), SystemClock(), stop_scope=scope)
    output = str(options.target.output)
    if not values["as_json"]:
        click.echo("\n".join([results(record), *more(record)]))
    if reason := record.ending.lost_checkpoint:
        raise DataError(f"The last checkpoint could not be written: {reason} The volume was written: {output}.")
    if record.ended_early:
        raise ScanStopped(f"The reconstruction was stopped early. The volume reached so far is in {output}.")
    if limit is not None:  # the limit has no default, because no limit suits every sample
        require(record.metrics, limit)


def require(metrics: Mapping[str, float], max_residual: float) -> None:
    """Raise QualityError if the data residual of a finished volume exceeds the limit."""
    name = "residual_held_out" if "residual_held_out" in metrics else "residual"
    if not metrics[name] <= max_residual:
        kind = "held-out projections" if name == "residual_held_out" else "projections used"
        raise QualityError(
            f"Check the report, the rotation axis and the flags of the scan: the residual of the {kind} is "
            f"{metrics[name]:.4g}, more than --max-residual {max_residual:g}. The volume and its report were written."
        )


def dry_run(options: ReconOptions, clock: Clock, as_json: bool) -> None:
    """Print the time, memory and disk space of a reconstruction."""
    from beamline.reconstruct.estimate import estimate

    with json_events(as_json) as sink:
        needs = estimate(options)
        sink(Done(needs, time=clock.now()))
    if not as_json:
        click.echo("\n".join(needs.lines()))


def _write_recipe(path: Path, text: str) -> None:
    if str(path) == "-":
        click.echo(text, nl=False)
    else:
        write_whole(path, text)
