"""`beamline home`: the stage searches its reference position, as an incremental encoder needs after power-on."""

from __future__ import annotations

import math
from contextlib import suppress
from pathlib import Path

import click

from beamline.cli.options import POSITIVE, config_argument, set_option
from beamline.core.errors import INTERRUPTED
from beamline.core.stop import terminated_like_interrupted
from drivers.base.errors import DeviceError


@click.command()
@config_argument
@click.option("--yes", is_flag=True, help="Do not ask whether the stage may turn.")
@click.option("--timeout", type=POSITIVE, default=300.0, show_default=True, help="Longest time of the search, s.")
@set_option
def home(file: Path, yes: bool, timeout: float, overrides: tuple[str, ...]) -> None:
    """Search the reference position of the stage in CONFIG.

    THE STAGE TURNS, possibly by a full turn and beyond its soft limits. No other device is connected. Ctrl-C stops
    the stage.

    Exit code: 0 done, 3 the stage has no reference or the search failed, 130 not confirmed or interrupted.
    """
    from beamline.config.load import load
    from beamline.instrument.connect import stage_alone

    config = load(file, overrides)
    stage_config = config.devices.stage
    if not yes:
        way = f"The {stage_config.kind} stage at {stage_config.port} will turn to find its reference. May it turn?"
        try:
            free = click.confirm(way, err=True)
        except click.Abort:  # Ctrl-C, or the end of input: there is no operator
            click.echo(err=True)
            free = False
        if not free:
            click.echo(
                "beamline: The search was not confirmed. Nothing has moved. Use --yes to search without a question.",
                err=True,
            )
            click.get_current_context().exit(INTERRUPTED)
    with terminated_like_interrupted(), stage_alone(config) as stage:
        try:
            stage.start_home()
            angle = stage.wait(timeout)
        except BaseException:
            # Also after a search that failed: the state of the controller is not known. The first error is reported.
            with suppress(DeviceError):
                stage.stop()
            raise
        click.echo(f"The stage has found its reference and is at {math.degrees(angle):.4f} deg.")
