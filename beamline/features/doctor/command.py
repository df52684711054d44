"""`beamline doctor`: checks this computer: camera, ports, disk and memory; nothing moves."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from beamline.cli.options import json_events, set_option
from beamline.core.events import Diagnosed, Done
from beamline.core.stop import terminated_like_interrupted
from beamline.core.text import printable
from beamline.features.doctor.check import Diagnosis, Grade
from drivers.base.clock import SystemClock

_STYLES = {
    Grade.OK: "green",
    Grade.WARNING: "yellow",
    Grade.FAILED: "bold red",
    Grade.NOT_APPLICABLE: "dim",
    Grade.CANNOT_CHECK: "dim",
}
_WIDTH = 120  # Columns on a stdout that is no terminal


@click.command()
@click.argument("file", metavar="[CONFIG]", required=False, type=click.Path(path_type=Path))
@click.option(
    "--session",
    is_flag=True,
    help="Also open the camera; this takes seconds, and no other program may use the camera meanwhile.",
)
@set_option
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event per check to stdout, then the counts.")
def doctor(file: Path | None, session: bool, overrides: tuple[str, ...], as_json: bool) -> None:
    """Check this computer: camera link, camera library, ports, disk, memory. Nothing moves.

    With CONFIG, each is compared with the needs of that scan: MB/s, space, memory. The speed of the disk is measured
    for a few seconds with a temporary file.

    Exit code: 0 no check failed, 1 a check failed, 2 wrong configuration.
    """
    from beamline.config.load import load
    from beamline.features.doctor.examine import examine

    if file is None and overrides:
        raise click.UsageError("--set needs a CONFIG.")
    clock, checks = SystemClock(), list[Diagnosis]()
    with terminated_like_interrupted(), json_events(as_json) as sink:
        config = None if file is None else load(file, overrides)
        if not as_json:
            click.echo("Measuring the disk takes a few seconds.", err=True)
        for check in examine(config, clock, session=session):
            checks.append(check)
            sink(Diagnosed(check, time=clock.now()))
        counts = Counter(check.verdict for check in checks)
        sink(Done({str(grade).replace(" ", "_"): counts[grade] for grade in Grade}, time=clock.now()))
    if not as_json:
        _show(checks, compared=file is not None)
        click.echo(", ".join(f"{counts[verdict]} {verdict}" for verdict in Grade if counts[verdict]))
    if counts[Grade.FAILED]:
        click.get_current_context().exit(1)


def _show(checks: Sequence[Diagnosis], compared: bool) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    out: Any = getattr(sys.stdout, "unfiltered", sys.stdout)
    console = Console(file=out, highlight=False, markup=False, emoji=False, width=None if out.isatty() else _WIDTH)
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for column in ("check", "verdict", "observed"):
        table.add_column(column, no_wrap=column != "observed")
    for check in checks:
        lines = [check.observed]
        if check.expected and (compared or check.verdict is not Grade.OK):
            lines.append(f"Expected: {check.expected}.")
        if check.advice:
            lines.append(f"{check.advice}.")
        table.add_row(printable(check.name), Text(check.verdict, _STYLES[check.verdict]), printable("\n".join(lines)))
    console.print(table)
