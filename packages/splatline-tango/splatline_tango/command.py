"""`beamline tango`: serves the running scan as a Tango device."""

from __future__ import annotations

import re
from pathlib import Path

import click


def _device_name(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if not re.fullmatch(r"[\w.-]+(/[\w.-]+){2}", value):
        raise click.BadParameter(f"{value!r} is not a device name; expected DOMAIN/FAMILY/MEMBER.")
    return value


@click.command()
@click.argument("runs", required=False, default="runs", type=click.Path(path_type=Path, file_okay=False))
@click.option("--device", default="splatline/scan/1", show_default=True, callback=_device_name, metavar="NAME",
              help="Name of the device.")  # fmt: skip
@click.option("--bind", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Network address on which clients may connect; 0.0.0.0: all addresses.")  # fmt: skip
@click.option("--port", default=10100, show_default=True, type=click.IntRange(1024, 65535),
              help="TCP port on which clients connect.")  # fmt: skip
@click.option(
    "--instance", metavar="NAME",
    help="Serve the devices that the database at TANGO_HOST lists for the server splatline/NAME, instead of --device.",
)  # fmt: skip
@click.option(
    "--control",
    is_flag=True,
    help="Let clients pause, resume, stop and abort the scan, and decide what the scan measures next.",
)
def tango(runs: Path, device: str, bind: str, port: int, instance: str | None, control: bool) -> None:
    """Serve the running scan as a Tango device.

    The device is the newest run of the folder RUNS (default ./runs). The command only reads the files of the run, so
    it cannot slow a scan down. Tango has no passwords: with --control, everybody who reaches the address can end a
    scan.

    Exit codes: 0 ended by Ctrl-C, 5 the address cannot be used, or the database does not answer.

    Example: beamline tango runs --device id19/tomo/scan --bind 0.0.0.0
    """
    from splatline_tango.device import ServerPlace, serve

    place = ServerPlace(bind, port, device, instance)
    serve(runs, place, control, lambda: click.echo(f"{place}. Ctrl-C ends the Tango device, not the scan."))
