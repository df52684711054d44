"""`beamline view`: one or two volumes as a page in the browser."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path

import click

from beamline.features.page.watch import bind_option, port_option, serve_shown


@click.command()
@click.argument("volume", metavar="VOLUME[::NAME]|RUN")
@click.argument("other", metavar="[OTHER[::NAME]|RUN]", required=False)
@port_option
@bind_option
@click.option("--open", "browse", is_flag=True, help="Open the page in this machine's browser.")
@click.option("--napari", "in_napari", is_flag=True, help="Show it in napari, where that is installed.")
@click.option("--labels", type=click.Path(path_type=Path), help="With --napari: labels of `segment`, or as a TIFF.")
def view(
    volume: str, other: str | None, port: int, bind: str, browse: bool, in_napari: bool, labels: Path | None
) -> None:
    """Show VOLUME, or the volume of RUN, as a page in the browser: slices, zoom, grey window, histogram, profile.

    OTHER is shown below it at the same places, and the difference where both have the same shape. Without OTHER the FBP
    is, where `beamline recon` kept one beside a doubtful volume. Of a volume above 512 MB slices across y and x are
    binned; those of an OME-Zarr are not (`beamline export`). The page is served to this machine alone: from elsewhere
    use an ssh tunnel, or --bind (not encrypted). NAME is an array in a file with several, as in FILE.h5::/entry/data.

    --napari shows VOLUME and OTHER in napari instead, in their units, with labels and the centres of the Gaussians.

    Exit code: 0 ended by Ctrl-C, 2 no port or no napari, 5 no volume.
    """
    if labels is not None and not in_napari:
        raise click.UsageError("--labels goes with --napari.")
    named = [_named(each) for each in (volume, other) if each is not None]
    if in_napari:
        from beamline.features.page.in_napari import show

        if any(name is not None for _, name in named):
            raise click.UsageError("--napari takes no ::NAME; copy the array to a file of its own.")
        show([path for path, _ in named], labels)
        return
    from beamline.features.page.app import viewer  # these load HDF5 and the server
    from beamline.features.page.serve import open_port, start
    from beamline.page.volume import ShownVolume

    with ExitStack() as opened:
        volumes = [opened.enter_context(closing(ShownVolume(path, dataset=name))) for path, name in named]
        if other is None and volumes[0].has_fbp:
            volumes.append(opened.enter_context(closing(ShownVolume(named[0][0], fbp=True))))
        server = start(lambda access: viewer(volumes, access), open_port(bind, port))
        serve_shown(server, browse)


def _named(text: str) -> tuple[Path, str | None]:
    """FILE::NAME as the file and the array in it; a file that has such a name itself comes first. Of the folder of a
    run, its volume."""
    from beamline.storage.interrupted import volume_file

    path, separator, name = text.rpartition("::")
    return (Path(path), name) if separator and not Path(text).exists() else (volume_file(Path(text)), None)
