"""`beamline ioc`: publishes the state of the running scan as EPICS process variables."""

from __future__ import annotations

import time
from contextlib import closing, suppress
from pathlib import Path

import click

from beamline.cli.options import say
from beamline.core.files import RUNS


@click.command()
@click.argument("runs", required=False, default=RUNS, type=click.Path(path_type=Path, file_okay=False))
@click.option("--prefix", default="splatline:", show_default=True, help="Prefix of the names of the process variables.")
@click.option(
    "--bind",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Network address to listen at; 0.0.0.0: all addresses.",
)
@click.option(
    "--control",
    is_flag=True,
    help="Let clients pause, resume, stop and abort the scan, and decide what is measured next. Default: read only.",
)
def ioc(runs: Path, prefix: str, bind: str, control: bool) -> None:
    """Publish the newest run in the folder RUNS (default ./runs) as EPICS process variables, over PVAccess.

    \b
    beamline ioc

    The command only reads the files of the run, so it cannot slow a scan down. EPICS has no passwords: with --control
    everybody who can reach the address can end a scan. Needs: pip install "splatline[epics]".

    Exit code: 0 ended by Ctrl-C, 2 p4p is not installed, 5 the address cannot be used.
    """
    from beamline.features.epics.ioc import RunServer
    from beamline.page.followed_run import PERIOD

    with closing(RunServer(runs, prefix, bind, control, say)) as server, suppress(KeyboardInterrupt):
        discovery = (
            "by broadcast" if bind == "0.0.0.0" else f"if EPICS_PVA_ADDR_LIST={bind} is set in their environment"
        )
        click.echo(
            f"Publishing {prefix}ScanStatus and other process variables at {bind}. Clients find these variables "
            f"{discovery} (docs/page.md). Ctrl-C ends this command, not the scan."
        )
        while True:
            server.look()
            time.sleep(PERIOD)
