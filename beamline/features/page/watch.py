"""`beamline watch`: a page in the browser that shows a run while it goes on, and afterwards."""

from __future__ import annotations

import os
import sys
import time
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.options import WholeRange, say
from beamline.cli.terminal import ACT, ENDS_WITHIN, LOOK
from beamline.core.files import RUNS
from beamline.core.process import at_end_of

if TYPE_CHECKING:
    from beamline.features.page.serve import PageServer

LOOPBACK, PORT = "127.0.0.1", 8642

port_option = click.option(
    "--port", default=PORT, show_default=True, type=WholeRange(0, 65535), help="Or the next free one."
)
bind_option = click.option(
    "--bind", default=LOOPBACK, show_default=True, metavar="ADDRESS", help="To listen at; 0.0.0.0: all."
)


@click.command()
@click.argument("path", metavar="[RUN|FILE|RUNS]", required=False, type=click.Path(path_type=Path))
@click.option("--control", is_flag=True, help="A second address, from which the scan can be paused and ended.")
@port_option
@bind_option
@click.option("--until-stdin-ends", "tethered", is_flag=True, hidden=True)
@click.option("--open", "browse", is_flag=True, help="Open the page in this machine's browser.")
def watch(path: Path | None, control: bool, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """Show the run in the folder RUN, or a scan FILE, as a page in the browser: views, flags, volume, states, log.

    Of a folder of RUNS (./runs, unless given): the running scan, else the newest run. The page only reads; it cannot
    slow the scan down or harm it. It is served to this machine alone: from elsewhere use an ssh tunnel, or --bind (not
    encrypted).

    Exit code: 0 ended by Ctrl-C, 2 no run, or no port, 5 no scan of this program.
    """
    from beamline.core.errors import ConfigError
    from beamline.features.page.app import page  # these load HDF5 and the server, which `scan -h` does not need
    from beamline.features.page.serve import open_port, start
    from beamline.page.run_files import Reader, watched
    from beamline.scan.runs import newest, runs_in
    from beamline.storage.interrupted import next_step
    from beamline.storage.writer_lock import held

    folder = path or Path(RUNS)
    if path is not None and not path.exists():
        there = ", ".join(run.name for run in runs_in(Path(RUNS))[:5])
        held_runs = f"the newest runs in {RUNS} are {there}" if there else f"there are no runs in {RUNS}"
        raise ConfigError(f"there is no file or folder {path}; {held_runs}.")
    what = watched(newest(folder) if path is None or (path.is_dir() and runs_in(path)) else folder)
    if not held(what.scan) and (advice := next_step(what.scan)):
        click.echo(advice, err=True)
    reader = Reader(what)
    try:
        reader.state()  # refuses a scan of another program before a page shows nothing
        server = start(lambda access: page(reader, access, say), open_port(bind, port), control=control)
        click.echo("Ctrl-C ends the page, not the scan.", err=True)
        if tethered:
            at_end_of(sys.stdin.fileno(), lambda: _end(server))
        serve_shown(server, browse)
    finally:
        reader.close()


def serve_shown(server: PageServer, browse: bool) -> None:
    """Print the addresses of a server, and serve until Ctrl-C. `browse`: open the page in the browser."""
    click.echo(f"{LOOK:<8}{server.addresses.look}")
    if server.addresses.act is not None:
        click.echo(f"{ACT:<8}{server.addresses.act}")
    sys.stdout.flush()
    if browse:
        webbrowser.open(server.addresses.act or server.addresses.look)
    with suppress(KeyboardInterrupt):
        server.run()


def _end(server: PageServer) -> None:
    """End this process; open pages are told within 3 s."""
    server.stop()
    time.sleep(ENDS_WITHIN)
    os._exit(0)
