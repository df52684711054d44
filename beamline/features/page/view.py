"""`beamline view`: a scan, or one or two volumes, as a page in the browser."""

from __future__ import annotations

from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beamline.cli.recipe import DATA, OUTPUT, Grouped, heading
from beamline.cli.selection_options import scan_options
from beamline.core.errors import DataError
from beamline.features.page.watch import bind_option, port_option, serve_shown

if TYPE_CHECKING:
    from beamline.storage.readers.base import ScanSource


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
@click.option("--napari", "in_napari", is_flag=True, help="Show it in napari, where that is installed.")
@click.option("--labels", type=click.Path(path_type=Path), help="With --napari: labels of `segment`, or as a TIFF.")
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

    OTHER is shown below it at the same places, and the difference where both have the same shape. Without OTHER the FBP
    is, where `beamline recon` kept one beside a doubtful volume. Of a volume above 512 MB slices across y and x are
    binned; those of an OME-Zarr are not (`beamline export`). The page is served to this machine alone: from elsewhere
    use an ssh tunnel, or --bind (not encrypted). NAME is an array in a file with several, as in FILE.h5::/entry/data.

    --napari shows VOLUME and OTHER in napari instead, in their units, with labels and the centres of the Gaussians.

    Exit code: 0 ended by Ctrl-C, 2 no port or no napari, 5 no scan and no volume.
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
        if other is None and volumes[0].has_fbp:
            volumes.append(opened.enter_context(closing(ShownVolume(named[0][0], fbp=True))))
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
    if (source.image_key != 0).any() or (source.angles == source.angles).any():
        return source
    source.close()
    return None


def _named(text: str) -> tuple[Path, str | None]:
    """FILE::NAME as the file and the array in it; a file that has such a name itself comes first. Of the folder of a
    run, its volume."""
    from beamline.storage.interrupted import volume_file

    path, separator, name = text.rpartition("::")
    return (Path(path), name) if separator and not Path(text).exists() else (volume_file(Path(text)), None)
