"""`beamline demo`: a simulated scan from trigger to volume, with a report, in about a minute."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path

import click

from beamline.cli.demo_run import run_demo
from beamline.cli.json_output import json_events
from beamline.cli.options import POSITIVE
from beamline.cli.scan import stop_signals
from beamline.cli.terminal import Terminal, results
from beamline.config.load import config_folder, load
from beamline.core.events import Event
from beamline.core.stop import StopRequest


@click.command()
@click.option("-o", "--output", type=click.Path(path_type=Path, file_okay=False), help="Where runs get their folders.")
@click.option("--seconds", type=POSITIVE, help="Of fitting after the scan; more is better.")
@click.option("--json", "as_json", is_flag=True, help="One event a line on stdout.")
def demo(output: Path | None, seconds: float | None, as_json: bool) -> None:
    """Scan a simulated battery, grow its volume while it turns, and judge the volume against the truth.

    What runs is configs/demo.yaml; everything is kept in a folder of its own (UTC time and sample).
    """
    overrides = () if seconds is None else (f"recon.seconds={seconds}",)
    with json_events(as_json) as sinks:
        config = load(config_folder() / "demo.yaml", overrides)
        stop = StopRequest()
        last: list[Event] = []
        with stop_signals(stop), Terminal(sys.stderr) as terminal:
            run_demo(config, output, [terminal, last.append, *sinks], stop, shlex.join(["beamline", *sys.argv[1:]]))
    if not as_json:
        click.echo(f"{'folder':<10}{Path(last[-1].data['output']).parent}")
        click.echo(results(last[-1].data))
