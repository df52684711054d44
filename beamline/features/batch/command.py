"""`beamline batch`: reconstructs many scans by one recipe, and keeps a table of them."""

from __future__ import annotations

import os
from pathlib import Path

import click

from beamline.cli.options import json_option
from beamline.cli.terminal import answering
from beamline.core.errors import DataError, ScanStopped
from beamline.features.batch.batch import TABLE, BatchOptions, run_batch


def scans_of(ctx: click.Context, param: click.Parameter, value: tuple[str, ...]) -> list[Path]:
    """Scans that match names and patterns, each once, in the order given."""
    from beamline.storage.interrupted import whole_scan  # here: help needs none of it

    scans: dict[Path, None] = {}
    for name in value:
        path, root = Path(name), Path(Path(name).anchor)
        matches = [path] if path.exists() else sorted(root.glob(str(path.relative_to(root))))
        if not matches:
            raise click.BadParameter(f"{name!r} is neither a file nor a pattern that matches one")
        for match in matches:
            scans[scan := whole_scan(match)] = None
            if not match.is_dir() and scan != Path(os.path.realpath(match)):
                click.echo(
                    f"{match} is a part of a run that was resumed: {scan}, which has all of it, is taken.", err=True
                )
    return list(scans)


@click.command()
@click.argument("scans", nargs=-1, required=True, callback=scans_of)
@click.option(
    "--config",
    type=click.Path(path_type=Path, exists=True, dir_okay=False),
    help="Recipe of the reconstructions, such as `beamline recon ... --write-config` writes. Default: -m auto.",
)
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    required=True,
    help="Folder of the results: new, or that of an earlier call with the same recipe, which is continued.",
)
@json_option
def batch(scans: list[Path], config: Path | None, output: Path, as_json: bool) -> None:
    """Reconstruct all SCANS, files or patterns such as "runs/*/scan.h5", one after the other, by one recipe.

    Each scan gets a folder in --output with its volume, report and log; batch.csv says what became of it, and why it
    failed. Called again, only scans without a volume are reconstructed. Ctrl-C keeps the scans that are done (exit
    code 4). Exit code 5: a scan failed.
    """
    if config is not None:
        from beamline.cli.recon import refuse_recipe  # here: help needs none of it

        refuse_recipe(config)
    options = BatchOptions(scans, config, output)
    with answering(as_json) as answer:
        try:
            rows = run_batch(options, answer.sink, answer.clock)
        except KeyboardInterrupt as stop:
            raise ScanStopped(f"The batch was stopped; {output / TABLE} says which scans are done.") from stop
        failed = [row for row in rows if not row.has_volume]
        counts = {"done": len(rows) - len(failed), "failed": len(failed), "output": output / TABLE}
        every = [] if failed else [f"{len(rows)} of {len(rows)} scans have a volume: {output / TABLE}"]
        answer.done(counts, *every)
    if failed:
        raise DataError(f"{len(failed)} of {len(rows)} scans failed; {output / TABLE} says why.")
