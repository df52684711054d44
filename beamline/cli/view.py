"""`beamline view`: one or two volumes as a page in the browser."""

from __future__ import annotations

import sys
import webbrowser
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import click

from beamline.cli.terminal import Terminal, counting
from beamline.cli.watch import LOOK, bind_option, port_option
from drivers.base.clock import SystemClock


@click.command()
@click.argument("volume", type=click.Path(path_type=Path))
@click.argument("other", required=False, type=click.Path(path_type=Path))
@port_option
@bind_option
@click.option("--open", "browse", is_flag=True, help="Open the page in this machine's browser.")
def view(volume: Path, other: Path | None, port: int, bind: str, browse: bool) -> None:
    """Show VOLUME as a page in the browser: slices, zoom, grey window, histogram, profile along a line.

    OTHER is shown below it at the same places, and the difference where both have the same shape. Without OTHER the FBP
    is, where `beamline recon` kept one beside a doubtful volume. Of a volume above
    512 MB slices across y and x are binned. The page is served to this machine alone: from elsewhere use an ssh
    tunnel, or --bind (not encrypted).

    Exit code: 0 ended by Ctrl-C, 2 no port, 5 no volume.
    """
    from beamline.page.serve import open_port, start  # these load HDF5 and the server
    from beamline.page.viewer import viewer
    from beamline.page.volume import ShownVolume

    with ExitStack() as opened, suppress(KeyboardInterrupt):
        with Terminal(sys.stderr) as terminal:
            progress = counting("slices", terminal, SystemClock())
            paths = [volume] if other is None else [volume, other]
            volumes = [opened.enter_context(closing(ShownVolume(path, progress))) for path in paths]
            if other is None and volumes[0].has_fbp:
                volumes.append(opened.enter_context(closing(ShownVolume(volume, progress, fbp=True))))
        server = start(lambda access: viewer(volumes, access), open_port(bind, port))
        click.echo(f"{LOOK:<8}{server.addresses.look}")
        sys.stdout.flush()
        if browse:
            webbrowser.open(server.addresses.look)
        server.run()
