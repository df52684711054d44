"""`beamline tradeoff`: which method and which settings give how much for how many seconds on this scan."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import Any

import click

from beamline.cli.json_output import json_events, terminated_like_interrupted
from beamline.cli.options import POSITIVE, SEED
from beamline.cli.selection_options import chosen, selection_options
from beamline.cli.terminal import Terminal
from beamline.core.errors import ScanStopped
from beamline.core.events import fan_out
from beamline.tradeoff.report import text
from beamline.tradeoff.run import TradeoffOptions, run_tradeoff
from drivers.clock import SystemClock
from recon.methods import names


def listed(ctx: click.Context, param: click.Parameter, value: str | None) -> tuple[str, ...]:
    """Names of methods, separated by commas; all where none are given."""
    if value is None:
        return names()
    wanted = tuple(dict.fromkeys(name.strip() for name in value.split(",")))
    unknown = [name for name in wanted if name not in names()]
    if unknown:
        raise click.BadParameter(f"{unknown[0]!r} is none of {', '.join(names())}")
    return wanted


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@click.option(
    "--truth",
    metavar="FILE[:A:B]",
    help="Volume to compare with (.npz, .npy, HDF5), slices A to B; else held-out views.",
)
@selection_options
@click.option(
    "--methods", callback=listed, metavar="A,B,...", help=f"Of {', '.join(names())}; all of them without this."
)
@click.option("--quick/--full", default=True, show_default=True, help="Few and short trials, or many and long ones.")
@click.option(
    "--max-seconds",
    type=POSITIVE,
    help="Wall time for all trials; the table is finished with those done until then.",
)
@click.option("--seed", type=SEED, default=0, show_default=True, help="Of everything random.")
@click.option(
    "-o",
    "--output",
    type=click.Path(path_type=Path, file_okay=False),
    help="New folder. Default: FILE's stem + _tradeoff.",
)
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def tradeoff(
    file: Path,
    truth: str | None,
    methods: tuple[str, ...],
    quick: bool,
    max_seconds: float | None,
    seed: int,
    output: Path | None,
    as_json: bool,
    **said: Any,
) -> None:
    """Reconstruct the scan in FILE in many ways, and show what quality costs in time and memory.

    Quality is PSNR and SSIM against --truth, or else how well views that no trial has seen are explained, and to which
    detail two halves of the views agree. Writes a folder with tradeoff.csv, tradeoff.json, pictures and a page. Ctrl-C
    ends it with the trials done so far (exit code 4; 130 and no folder where there are none).
    """
    source, selection = chosen(file, seed, said)
    options = TradeoffOptions(
        source=source,
        selection=selection,
        folder=output or Path(f"{file.stem}_tradeoff"),
        methods=methods,
        depth="quick" if quick else "full",
        max_seconds=max_seconds,
        truth=truth,
        seed=seed,
        command=shlex.join(["beamline", *sys.argv[1:]]),
    )
    with terminated_like_interrupted(), json_events(as_json) as json_sinks, Terminal(sys.stderr) as terminal:
        table = run_tradeoff(options, fan_out(*(json_sinks or [terminal])), SystemClock())
    if not as_json:
        click.echo(text(table))
    if table.stopped:
        counts = f"{table.n_done} of {len(table.outcomes)}"
        raise ScanStopped(f"The trade-off was ended after {counts} trials; {options.folder} holds them.")
