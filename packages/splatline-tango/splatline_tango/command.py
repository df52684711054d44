"""`beamline tango`: the running scan as a Tango device."""

from __future__ import annotations

import re
from pathlib import Path

import click


def _device_name(ctx: click.Context, param: click.Parameter, value: str) -> str:
    if not re.fullmatch(r"[\w.-]+(/[\w.-]+){2}", value):
        raise click.BadParameter(f"{value!r} is not a name of a device; expected DOMAIN/FAMILY/MEMBER.")
    return value


@click.command()
@click.argument("runs", required=False, default="runs", type=click.Path(path_type=Path, file_okay=False))
@click.option("--device", default="splatline/scan/1", show_default=True, callback=_device_name, metavar="NAME",
              help="Name of the device.")  # fmt: skip
@click.option("--bind", default="127.0.0.1", show_default=True, metavar="ADDRESS",
              help="Network address to listen at; 0.0.0.0: all addresses.")  # fmt: skip
@click.option("--port", default=10100, show_default=True, type=click.IntRange(1024, 65535),
              help="TCP port to listen at.")  # fmt: skip
@click.option(
    "--instance", metavar="NAME",
    help=("Publish the devices that the database at TANGO_HOST lists for the server splatline/NAME. --device is then "
        "not used."),
)  # fmt: skip
@click.option(
    "--control",
    is_flag=True,
    help=("Let clients pause, resume, stop and abort the scan, and decide what is measured next. Default: read only."),
)
def tango(runs: Path, device: str, bind: str, port: int, instance: str | None, control: bool) -> None:
    """Publish the state of the running scan as a Tango device.

    \b
    beamline tango

    The newest run in the folder RUNS (default ./runs) is published. The command only reads the files of the run, so it
    cannot slow a scan down. Tango has no passwords: with --control everybody who can reach the address can end a scan.

    Exit code: 0 ended by Ctrl-C, 5 the address cannot be used, or the database does not answer.
    """
    from splatline_tango.device import ServerPlace, serve

    place = ServerPlace(bind, port, device, instance)
    serve(runs, place, control, lambda: click.echo(f"{place}. Ctrl-C ends this command, not the scan."))
