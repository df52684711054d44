"""`beamline archive`: compresses a scan file, and compares the copy with it."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.options import NameChoice, as_scan, json_option
from beamline.cli.terminal import answering
from beamline.core.files import refuse_existing
from beamline.core.text import count, size, spans

_PATH = click.Path(path_type=Path)
CODECS = ("blosc2", "bitshuffle-zstd", "bitshuffle-lz4")  # The first is the default


@click.command()
@click.argument("scan", metavar="SCAN|RUN", type=_PATH, callback=as_scan)
@click.option("-o", "--output", metavar="FILE", type=_PATH, required=True, help="The archive to write.")
@click.option(
    "--codec",
    type=NameChoice(CODECS),
    default=CODECS[0],
    show_default=True,
    help="Compressor, all lossless. blosc2: zstd after a bit shuffle. bitshuffle-lz4: fast, and most widely read.",
)
@click.option("--keep-damaged", is_flag=True, help="Include frames that differ from their checksum, unchanged.")
@json_option
def archive(scan: Path, output: Path, codec: str, keep_damaged: bool, as_json: bool) -> None:
    """Write a compressed copy of the HDF5 scan SCAN, and compare every frame of it with SCAN.

    The copy is lossless and opens like SCAN. Each frame is read back from the finished file and compared by its CRC-32.
    SCAN is never deleted: the last line names the files that may be. Nothing is overwritten, and a failure leaves
    nothing.
    """
    from beamline.features.archive.archive import archive as archive_scan

    with answering(as_json) as answer:
        refuse_existing(output)
        done = archive_scan(scan, output, codec, keep_damaged=keep_damaged, progress=answer.counting("archive"))
        ratio, seconds = done.raw_bytes / done.bytes, answer.seconds
        facts = {**vars(done), "codec": codec, "ratio": ratio, "seconds": seconds}
        damaged = count(len(done.damaged), "frame")
        altered = f"what {scan} says of frames {spans(done.altered)} is not as it was written; kept unchanged"
        raw, *others = map(str, done.sources)
        answer.done(
            facts,
            f"output   {output} ({codec})",
            f"size     {size(done.raw_bytes)} -> {size(done.bytes)}, ratio {ratio:.2f}",
            f"speed    {done.raw_bytes / max(seconds, 1e-9) / 1e6:.0f} MB/s, written and compared",
            *([f"damaged  {damaged} of {scan}, kept unchanged: {spans(done.damaged)}"] if done.damaged else []),
            *([f"altered  {altered}"] if done.altered else []),
            f"verified {count(done.frames, 'frame')}, each as in {scan}"
            + (f", also its {count(len(done.damaged), 'damaged frame')}" if done.damaged else ""),
            f"the raw file may be deleted: {raw}"
            + (f"; where nothing but its frames is wanted of them, also {', '.join(others)}" if others else ""),
        )
