"""`beamline watch`, `runs` and `view`: show a run, the runs in a folder, a scan or volumes in the browser."""

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
    "--port",
    default=PORT,
    show_default=True,
    type=WholeRange(0, 65535),
    help="Port of the page. If the port is in use, the next free port is used.",
)
bind_option = click.option(
    "--bind",
    default=LOOPBACK,
    show_default=True,
    metavar="ADDRESS",
    help="Network address of the page. 0.0.0.0: every computer in the network can open it (not encrypted).",
)


@click.command()
@click.argument("path", metavar="[RUN|FILE|RUNS]", required=False, type=click.Path(path_type=Path))
@click.option("--control", is_flag=True, help="Also print an address from which the scan can be paused and ended.")
@port_option
@bind_option
@click.option("--until-stdin-ends", "tethered", is_flag=True, hidden=True)
@click.option("--open", "browse", is_flag=True, help="Open the page in the browser of this computer.")
def watch(path: Path | None, control: bool, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """Show a run in the browser: projections, flags, volume, states and log, during the scan and afterwards.

    \b
    beamline watch        the running scan in ./runs, otherwise the newest run
    beamline watch RUN    the run in the folder RUN

    You can also give a scan FILE, or another folder of RUNS. The page only reads files, so it cannot slow the scan
    down or harm it. Only this computer can open the page. To open it from another one, use an ssh tunnel or --bind
    (not encrypted).

    Exit code: 0 you pressed Ctrl-C, 2 there is no run or no port is free, 5 the file is not a scan of this program.
    """
    # imported here, because these modules load HDF5 and the server, which help does not need
    from beamline.features.page.app import page
    from beamline.features.page.serve import open_port, start
    from beamline.page.run_files import Reader, watched
    from beamline.scan.runs import newest, runs_in
    from beamline.storage.interrupted import next_step
    from beamline.storage.run_record import alive
    from beamline.storage.writer_lock import held

    folder = path or Path(RUNS)
    if path is not None and not path.exists():
        run_names = ", ".join(run.name for run in runs_in(Path(RUNS))[:5])
        held_runs = f"the newest runs in {RUNS} are {run_names}" if run_names else f"there are no runs in {RUNS}"
        raise ConfigError(f"{path} does not exist; {held_runs}.")
    watched_run = watched(newest(folder) if path is None or (path.is_dir() and runs_in(path)) else folder)
    if not (held(watched_run.scan) if watched_run.folder is None else alive(watched_run.folder)) and (
        advice := next_step(watched_run.scan)
    ):
        click.echo(advice, err=True)
    reader = Reader(watched_run)
    try:
        reader.state()  # raises an error for a scan of another program, which the page cannot show
        server = start(lambda access: page(reader, access, say), open_port(bind, port), control=control)
        click.echo("Press Ctrl-C to close the page. The scan continues.", err=True)
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
    """End this process. Open pages show within 3 s that the server has ended."""
    server.stop()
    time.sleep(ENDS_WITHIN)
    os._exit(0)


@click.command()
@click.argument("folder", required=False, type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option("--json", "as_json", is_flag=True, help="Print one JSON event to stdout.")
@click.option("--page", "as_page", is_flag=True, help="Show the list in the browser; each run has a link to its page.")
@port_option
@bind_option
@click.option("--until-stdin-ends", "tethered", is_flag=True, hidden=True)
@click.option("--open", "browse", is_flag=True, help="With --page: open the list in the browser of this computer.")
def runs(folder: Path | None, as_json: bool, as_page: bool, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """List the runs in FOLDER (default ./runs), newest first: sample, frames, state, size on the disk, flags.

    \b
    beamline runs
    beamline runs --page    the same in the browser

    A resumed run is one line. For an incomplete run, the number of frames in its files and the planned number are
    shown. The state `died` means that the process ended before it could write its last state; a line then says what
    you can do.

    Exit code: 0 the list is complete (it may be empty), 2 the folder does not exist or no port is free.
    """
    from beamline.scan.runs import HEAD, cells, describe, runs_in

    folder = folder or Path(RUNS)
    if not folder.is_dir():
        raise ConfigError(f"the folder {folder} does not exist: name the folder that has the runs.")
    if as_page:
        if as_json:
            raise click.UsageError("--page cannot be combined with --json.")
        _serve(folder, port, bind, tethered, browse)
        return
    with answering(as_json) as answer:
        runs = [describe(run) for run in runs_in(folder)]
        answer.done({"folder": folder, "runs": runs}, *([aligned([HEAD, *map(cells, runs)])] if runs else []))
    if as_json:
        return
    if not runs:
        click.echo(f"There are no runs in {folder}.", err=True)
    for run in runs:
        if sentence := run.next_step or run.ended:
            click.echo(f"{run.folder.name}: {sentence}", err=True)


def _serve(folder: Path, port: int, bind: str, tethered: bool, browse: bool) -> None:
    """Serve the list of runs. tethered: True if the program that runs the scans started this process. It writes the
    folders of the scans to stdin, one per line, and its page may control these scans."""
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
                lambda text: own.extend(map(Path, text.decode().splitlines())),
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
@click.option("--open", "browse", is_flag=True, help="Open the page in the browser of this computer.")
@click.option(
    "--napari",
    "in_napari",
    is_flag=True,
    help="Show the volume in napari instead of the browser, if napari is installed.",
)
@click.option(
    "--labels",
    type=click.Path(path_type=Path),
    help="With --napari: file with labels, from `beamline structure` or as a TIFF.",
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
    """Show a scan, or one or two volumes, in the browser: slices, zoom, grey window, histogram, profile.

    \b
    beamline view VOLUME.h5             or RUN: the volume of a run
    beamline view VOLUME.h5 OTHER.h5    two volumes and their difference
    beamline view SCAN.h5               corrected projections and sinograms

    For a SCAN, in any format that `recon` reads, the page also shows mean images, the angles, two opposite projections
    over each other and an FBP slice. You can change axis and tilt there, and copy them as options for `recon`. TIFFs
    count as a volume, unless their names, a file of angles or an option show that they are a scan.

    A volume that was reconstructed with a reference (`recon --reference`) is shown below the moved reference, with
    their difference: what changed.

    OTHER is shown below VOLUME at the same positions; the difference is shown if both have the same shape. For volumes
    above 512 MB, slices across y and x are binned, except those of an OME-Zarr (`beamline export` makes one). NAME is
    an array in a file with several arrays, for example FILE.h5::/entry/data. Only this computer can open the page. To
    open it from another one, use an ssh tunnel or --bind (not encrypted).

    --napari shows VOLUME and OTHER in napari, in their units, with labels and the centres of the Gaussians.

    Exit code: 0 you pressed Ctrl-C, 2 no port is free or napari is not installed, 5 the file is neither a scan nor a
    volume.
    """
    if labels is not None and not in_napari:
        raise click.UsageError("--labels works only with --napari.")
    named = [_named(each) for each in (volume, other) if each is not None]
    if in_napari:
        from beamline.features.page.in_napari import show

        if any(name is not None for _, name in named):
            raise click.UsageError(
                "--napari cannot open FILE::NAME (one of several arrays); copy this array to a separate file."
            )
        show([path for path, _ in named], labels)
        return
    from beamline.features.page.app import viewer  # these load HDF5 and the server
    from beamline.features.page.serve import open_port, start
    from beamline.page.volume import ShownVolume, moved_reference

    with ExitStack() as opened:
        source = None if named[0][1] is not None else _scan(named[0][0], scan_facts)
        if source is not None:
            from beamline.page.shown_scan import ShownScan  # imported here, because it loads the corrections and FBP

            if other is not None:
                source.close()
                raise click.UsageError(f"{volume} is a scan, and a scan can only be shown alone: leave out {other}.")
            scan = opened.enter_context(closing(ShownScan(source)))
            server = start(lambda access: viewer([scan.stack], access, scan), open_port(bind, port))
            serve_shown(server, browse)
            return
        volumes = [opened.enter_context(closing(ShownVolume(path, dataset=name))) for path, name in named]
        if other is None and named[0][1] is None and (before := moved_reference(named[0][0], opened)) is not None:
            volumes.insert(0, opened.enter_context(closing(before)))
        server = start(lambda access: viewer(volumes, access), open_port(bind, port))
        serve_shown(server, browse)


def _scan(path: Path, facts: dict[str, Any]) -> ScanSource | None:
    """The opened scan of a file; None if the file is a volume. Raises DataError if a scan cannot be read."""
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
    is_zip = path.suffix.lower() == ".zip"  # a .zip is never a volume
    if is_zip or source.table.views.size < len(source.table) or source.table.views_with_angles.size:
        return source
    source.close()
    return None


def _named(text: str) -> tuple[Path, str | None]:
    """Split FILE::NAME into file and array, unless a file has this whole name. For the folder of a run, the file is its
    volume."""
    from beamline.storage.interrupted import volume_file

    path, separator, name = text.rpartition("::")
    return (Path(path), name) if separator and not Path(text).exists() else (volume_file(Path(text)), None)
