"""`beamline ioc`: the running scan as EPICS process variables."""

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
    "--bind", default="127.0.0.1", show_default=True, metavar="ADDRESS", help="Address to listen at; 0.0.0.0: all."
)
@click.option(
    "--control", is_flag=True, help="Let clients pause, resume, stop and abort the scan, and choose what is next."
)
def ioc(runs: Path, prefix: str, bind: str, control: bool) -> None:
    """Serve the newest run of the folder RUNS (default ./runs) as EPICS process variables, by PVAccess.

    It only reads the run's files, so that it cannot slow a scan down. EPICS has no passwords: with --control everybody
    who reaches the address may end a scan. Needs: pip install "splatline[epics]".

    Exit code: 0 ended by Ctrl-C, 2 p4p is not installed, 5 the address cannot be listened at.
    """
    from beamline.features.epics.ioc import RunServer
    from beamline.page.followed_run import PERIOD

    with closing(RunServer(runs, prefix, bind, control, say)) as server, suppress(KeyboardInterrupt):
        found = "by their broadcasts" if bind == "0.0.0.0" else f"with EPICS_PVA_ADDR_LIST={bind} in their environment"
        click.echo(
            f"{prefix}ScanStatus and others at {bind}; clients find them {found} (docs/page.md). Ctrl-C ends this, not "
            "the scan."
        )
        while True:
            server.look()
            time.sleep(PERIOD)
