"""`beamline publish`: publishes the running scan in the form in which an areaDetector publishes its frames."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

import click

from beamline.cli.options import say

if TYPE_CHECKING:
    from splatline_areadetector.publish_detector import PublishedDetector
    from splatline_areadetector.publish_frames import RunFrames
    from splatline_areadetector.publish_servers import ImageServer

_PREFIX = re.compile(r"[\w.\-:]{0,39}[\w.\-]:")
_IDLE = 0.005  # s between two reads of the file
_CLIENTS_EVERY = 1.0  # s between two counts of dropped frames


def _prefix(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if not _PREFIX.fullmatch(value):
        raise click.BadParameter(
            f"{value!r} is not a prefix of EPICS; expected letters, digits, _ . - and a colon at the end, such as "
            "2bma:SPL:."
        )
    return value


@click.command()
@click.argument("runs", required=False, default="runs", type=click.Path(path_type=Path, file_okay=False))
@click.option("--prefix", default="splatline:", show_default=True, callback=_prefix,
              help="Prefix of the names of the process variables.")  # fmt: skip
@click.option(
    "--bind",
    default="127.0.0.1",
    show_default=True,
    metavar="ADDRESS",
    help="Network address on which clients may connect; 0.0.0.0: all addresses.",
)
@click.option("--port", default=None, type=click.IntRange(0, 65535),
              help=(
                  "TCP port of the image. Default: the port of EPICS, or any free port if another program uses the "
                  "port of EPICS."
              ))  # fmt: skip
@click.option("--files", default=None, type=click.Path(path_type=Path, file_okay=False, exists=True), metavar="FOLDER",
              help="Let clients request that frames are written to files below this folder. "
                   "Default: no files.")  # fmt: skip
def publish(runs: Path, prefix: str, bind: str, port: int | None, files: Path | None) -> None:
    """Show a running scan to programs that expect an EPICS areaDetector, such as viewers and bluesky.

    Publishes the frames of the newest run in the folder RUNS (default ./runs). The command only reads the files of the
    run, so it cannot slow a scan down, and no client can start, stop or change the scan. With --files, everybody who
    reaches the address can make it write frames below that folder.

    Exit codes: 0 ended by Ctrl-C, 2 p4p or softioc is not installed, 5 the address or port cannot be used.

    Example: beamline publish runs --prefix 2bma:SPL: --bind 0.0.0.0
    """
    from splatline_areadetector.publish_detector import PublishedDetector, records
    from splatline_areadetector.publish_frames import RunFrames
    from splatline_areadetector.publish_servers import ImageServer, RecordServer

    name = f"{prefix}Pva1:Image"
    with closing(ImageServer(name, bind, port)) as image:
        detector = PublishedDetector(lambda record, value: put(record, value), files, say)
        put = RecordServer(prefix, records(name), bind, detector.asked).put
        with closing(detector), closing(RunFrames(runs, say)) as frames, suppress(KeyboardInterrupt):
            click.echo(
                f"Publishing the image {name} at {bind}:{image.port}, and the records {prefix}cam1: and "
                f"{prefix}HDF1:. Ctrl-C ends the publishing, not the scan."
            )
            _follow(frames, image, detector, put)


def _follow(
    frames: RunFrames, image: ImageServer, detector: PublishedDetector, put: Callable[[str, int], None]
) -> NoReturn:
    """Publish frames as they come, until Ctrl-C."""
    run, counted, missed = None, time.monotonic(), 0
    while True:
        frame = frames.next()
        if frames.run != run:
            run = frames.run
            detector.began(frames.shape, frames.dtype)
        if frame is not None:
            image.post(frame)
            detector.take(frame)
        else:
            time.sleep(_IDLE)
        if time.monotonic() - counted >= _CLIENTS_EVERY:
            counted, before = time.monotonic(), missed
            missed = sum(client.missed for client in image.clients().values())
            if missed != before:
                put("Pva1:DroppedArrays_RBV", missed)
