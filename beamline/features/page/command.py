"""`beamline watch`, `runs` and `view`: a run, the runs in a folder, a scan or volumes, as pages in the browser."""

from __future__ import annotations

import os
import sys
import time
import webbrowser
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.options import WholeRange, say
from beamline.cli.recipe import DATA, OUTPUT, Grouped, heading
from beamline.cli.selection_options import scan_options
from beamline.cli.terminal import ACT, ENDS_WITHIN, LOOK, answering
from beamline.core.errors import ConfigError, DataError
from beamline.core.files import RUNS
from beamline.core.process import at_end_of
from beamline.core.text import aligned

if TYPE_CHECKING:
    from beamline.features.page.serve import PageServer
    from beamline.storage.readers.base import ScanSource


LOOPBACK, PORT = "127.0.0.1", 8642

port_option = click.option(
    "--port", default=PORT, show_default=True, type=WholeRange(0, 65535), help="Port, or else the next free one."
)
bind_option = click.option(
    "--bind", default=LOOPBACK, show_default=True, metavar="ADDRESS", help="To listen at; 0.0.0.0: all."
)


@click.command()
@click.argument("path", metavar="[RUN|FILE|RUNS]", required=False, type=click.Path(path_type=Path))
@click.option("--control", is_flag=True, help="Print a second address, which can pause and end the scan.")
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
    from beamline.features.page.app import page  # these load HDF5 and the server, which `scan -h` does not need
    from beamline.features.page.serve import open_port, start
    from beamline.page.run_files import Reader, watched
    from beamline.scan.runs import newest, runs_in
    from beamline.storage.interrupted import next_step
    from beamline.storage.run_record import alive
    from beamline.storage.writer_lock import held

    folder = path or Path(RUNS)
    if path is not None and not path.exists():
        there = ", ".join(run.name for run in runs_in(Path(RUNS))[:5])
        held_runs = f"the newest runs in {RUNS} are {there}" if there else f"there are no runs in {RUNS}"
        raise ConfigError(f"there is no file or folder {path}; {held_runs}.")
    what = watched(newest(folder) if path is None or (path.is_dir() and runs_in(path)) else folder)
    if not (held(what.scan) if what.folder is None else alive(what.folder)) and (advice := next_step(what.scan)):
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
    """End this process; open pages show it within 3 s."""
    server.stop()
    time.sleep(ENDS_WITHIN)
    os._exit(0)


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event to stdout.")
@click.option("--page", "as_page", is_flag=True, help="Show the runs in the browser; a link opens the page of each.")
@port_option
@bind_option
@click.option("--until-stdin-ends", "tethered", is_flag=True, hidden=True)
@click.option("--open", "browse", is_flag=True, help="With --page: open it in this machine's browser.")
def runs(folder: Path | None, as_json: bool, as_page: bool, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """List the runs in FOLDER (./runs), newest first: sample, frames, state, size on the disk, flags.

    A run that was resumed is one line. A run that is not complete shows the frames in its files and the frames planned.
    `died`: its process ended without a word; a line says what can be done with it.

    Exit code: 0 also where there is no run, 2 no folder, or no port.
    """
    from beamline.scan.runs import HEAD, cells, describe, runs_in

    folder = folder or Path(RUNS)
    if not folder.is_dir():
        raise ConfigError(f"there is no folder {folder} here: name the one that has the runs.")
    if as_page:
        if as_json:
            raise click.UsageError("--page does not go with --json.")
        _serve(folder, port, bind, tethered, browse)
        return
    with answering(as_json) as answer:
        runs = [describe(run) for run in runs_in(folder)]
        answer.done({"folder": folder, "runs": runs}, *([aligned([HEAD, *map(cells, runs)])] if runs else []))
    if as_json:
        return
    if not runs:
        click.echo(f"There is no run in {folder}.", err=True)
    for run in runs:
        if sentence := run.next_step or run.ended:
            click.echo(f"{run.folder.name}: {sentence}", err=True)


def _serve(folder: Path, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """tethered: to the program whose runs these are: it tells their folders, a line each, and its page may act."""
    from beamline.features.page.serve import (
        RunBrowser,  # these load HDF5 and the server
        open_port,
        start,
    )

    own = list[Path]()
    with closing(RunBrowser(folder, own)) as runs:
        server = start(runs.app, open_port(bind, port), control=tethered)
        if tethered:
            at_end_of(
                sys.stdin.fileno(),
                lambda: _end(server),
                lambda told: own.extend(map(Path, told.decode().splitlines())),
            )
        serve_shown(server, browse)


@click.command(
    cls=Grouped,
    first=("port", "bind", "browse", "in_napari", "labels", "quantity", "angles", "darks", "flats", "data_path"),
)
@click.argument("volume", metavar="SCAN|VOLUME[::NAME]|RUN")
@click.argument("other", metavar="[OTHER[::NAME]|RUN]", required=False)
@heading(DATA)
@scan_options
@heading(OUTPUT)
@port_option
@bind_option
@click.option("--open", "browse", is_flag=True, help="Open the page in this machine's browser.")
@click.option("--napari", "in_napari", is_flag=True, help="Show the volume in napari, if installed.")
@click.option(
    "--labels", type=click.Path(path_type=Path), help="With --napari: labels from `structure`, or a TIFF of labels."
)
def view(
    volume: str,
    other: str | None,
    port: int,
    bind: str,
    browse: bool,
    in_napari: bool,
    labels: Path | None,
    **scan_facts: Any,
) -> None:
    """Show SCAN, VOLUME or the volume of RUN as a page in the browser: slices, zoom, grey window, histogram, profile.

    Of SCAN, of any format that `recon` reads, the slices are its views over the flats and sinograms. Means, angles, a
    pair of opposite views over each other and a slice by FBP are shown with them, for any axis and tilt, which are
    copied as options. TIFFs are a volume unless names, a file of angles or an option say that they are a scan.

    OTHER is shown below it at the same places, and the difference where both have the same shape. Of a volume above
    512 MB slices across y and x are binned; those of an OME-Zarr are not (`beamline export`). The page is served to
    this machine alone: from elsewhere use an ssh tunnel, or --bind (not encrypted). NAME is an array in a file with
    several, as in FILE.h5::/entry/data.

    --napari shows VOLUME and OTHER in napari instead, in their units, with labels and the centres of the Gaussians.

    Exit code: 0 ended by Ctrl-C, 2 no port or no napari, 5 no scan and no volume.
    """
    if labels is not None and not in_napari:
        raise click.UsageError("--labels goes with --napari.")
    named = [_named(each) for each in (volume, other) if each is not None]
    if in_napari:
        from beamline.features.page.in_napari import show

        if any(name is not None for _, name in named):
            raise click.UsageError("--napari takes no ::NAME; copy the array to a separate file.")
        show([path for path, _ in named], labels)
        return
    from beamline.features.page.app import viewer  # these load HDF5 and the server
    from beamline.features.page.serve import open_port, start
    from beamline.page.volume import ShownVolume

    with ExitStack() as opened:
        source = None if named[0][1] is not None else _scan(named[0][0], scan_facts)
        if source is not None:
            from beamline.page.shown_scan import ShownScan  # it loads corrections and FBP

            if other is not None:
                source.close()
                raise click.UsageError(f"{volume} is a scan, which is shown alone: leave out {other}.")
            scan = opened.enter_context(closing(ShownScan(source)))
            server = start(lambda access: viewer([scan.stack], access, scan), open_port(bind, port))
            serve_shown(server, browse)
            return
        volumes = [opened.enter_context(closing(ShownVolume(path, dataset=name))) for path, name in named]
        server = start(lambda access: viewer(volumes, access), open_port(bind, port))
        serve_shown(server, browse)


def _scan(path: Path, facts: dict[str, Any]) -> ScanSource | None:
    """The scan in a file, opened; None where it is a volume. DataError: a scan that cannot be read."""
    from beamline.storage import hdf5
    from beamline.storage.readers.open import SourceOptions, open_scan, scan_format
    from beamline.storage.volume_file import SUFFIXES
    from beamline.storage.volumes.files import volume_format

    if any(facts.values()):
        return open_scan(SourceOptions(path, **facts))
    if volume_format(path) is not None:
        return None
    if path.is_file() and hdf5.is_hdf5(path):
        return None if scan_format(path) is None else open_scan(path)
    try:
        source = open_scan(path)
    except DataError:
        if path.is_file() and not path.name.lower().endswith(SUFFIXES):
            raise
        return None
    is_zip = path.suffix.lower() == ".zip"  # which no volume is
    if is_zip or source.table.views.size < len(source.table) or source.table.views_with_angles.size:
        return source
    source.close()
    return None


def _named(text: str) -> tuple[Path, str | None]:
    """FILE::NAME split into file and array, unless a file has this whole name; of the folder of a run, its volume."""
    from beamline.storage.interrupted import volume_file

    path, separator, name = text.rpartition("::")
    return (Path(path), name) if separator and not Path(text).exists() else (volume_file(Path(text)), None)
