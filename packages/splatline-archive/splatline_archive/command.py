"""`beamline archive`: compresses a scan file, and compares the copy with it."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.options import as_scan, json_option
from beamline.cli.terminal import answering
from beamline.core.files import refuse_existing
from beamline.core.text import size

CODECS = ("blosc2", "bitshuffle-zstd", "bitshuffle-lz4")  # The first is the default
_PATH = click.Path(path_type=Path)


@click.command()
@click.argument("scan", metavar="SCAN|RUN", type=_PATH, callback=as_scan)
@click.option("-o", "--output", metavar="FILE", type=_PATH, required=True, help="The archive to write.")
@click.option(
    "--codec", type=click.Choice(CODECS), default=CODECS[0], show_default=True,
    help="Compressor, all lossless. blosc2: zstd after a bit shuffle. bitshuffle-lz4: fast, and most widely read.",
)  # fmt: skip
@json_option
def archive(scan: Path, output: Path, codec: str, as_json: bool) -> None:
    """Write a compressed copy of a scan file, compared with it frame by frame.

    The copy is lossless, and opens like SCAN, an HDF5 file. Each frame is read back from the finished file and compared
    by its CRC-32. SCAN is never deleted, nothing is overwritten, and a failure leaves nothing.
    """
    from splatline_archive.archive import archive as write_archive

    with answering(as_json) as answer:
        refuse_existing(output)
        done = write_archive(scan, output, codec, answer.counting("archive"))
        ratio = done.raw_bytes / done.bytes
        answer.done(
            {**vars(done), "codec": codec, "ratio": ratio, "seconds": answer.seconds},
            f"output   {output} ({codec})",
            f"size     {size(done.raw_bytes)} -> {size(done.bytes)}, ratio {ratio:.2f}",
            f"verified {done.frames} frames, each as in {', '.join(map(str, done.sources))}",
        )
