"""`beamline config`, `check`: prints a template, a configuration with all defaults, the schema, and a scan's plan."""

from __future__ import annotations

import json
from pathlib import Path

import click

from beamline.cli.options import config_argument, json_events, json_option, set_option
from beamline.core.events import Done
from drivers.base.clock import SystemClock


@click.group()
def config() -> None:
    """Print a configuration template, a complete configuration, or the schema."""


@config.command(short_help="Print a configuration template to edit.")
@click.option("--instrument", is_flag=True, help="A template for a real instrument instead of simulated devices.")
@click.argument("file", metavar="", required=False)
def init(instrument: bool, file: str | None) -> None:
    """Print a complete, commented configuration to edit: beamline config init > my.yaml"""
    if file is not None:
        raise click.UsageError(f"config init prints a configuration and writes no file: beamline config init > {file}")
    from beamline.config.load import config_folder

    name = "instrument.yaml" if instrument else "simulated.yaml"
    click.echo((config_folder() / name).read_text(encoding="utf-8"), nl=False)


@config.command(short_help="Print a configuration with all defaults.")
@config_argument
@set_option
def show(file: Path, overrides: tuple[str, ...]) -> None:
    """Print CONFIG as a scan would use it: with all defaults, --set and BEAMLINE_* variables applied."""
    from beamline.config.load import load, resolved_yaml

    click.echo(resolved_yaml(load(file, overrides)), nl=False)


@config.command("schema", short_help="Print the JSON schema of a configuration.")
def print_schema() -> None:
    """Print the JSON schema of a configuration, for editors that complete and check YAML files."""
    from beamline.config.load import schema

    click.echo(json.dumps(schema(), indent=2))


@click.command()
@config_argument
@set_option
@click.option("--rehearse", is_flag=True, help="As `beamline scan --rehearse` would run it.")
@json_option
def check(file: Path, overrides: tuple[str, ...], rehearse: bool, as_json: bool) -> None:
    """Validate CONFIG. Nothing moves.

    Prints the timeline of the scan: speed, taxi, angular step in counts, motion blur and rolling-shutter skew in
    pixels, duration, bytes to write and free disk space.

    Exit code: 0 valid, 2 wrong configuration or violated limit.
    """
    from beamline.config.load import load
    from beamline.scan.preflight import doubts, dry_run, refuse_violations

    with json_events(as_json) as sink:
        loaded = load(file, overrides, rehearse=rehearse)
        for sentence in doubts(loaded):
            click.echo(f"Warning: {sentence}", err=True)
        worked = dry_run(loaded)
        if not as_json:
            click.echo("\n".join(worked.lines()))
        refuse_violations(worked.timeline)
        sink(Done(worked.data(), time=SystemClock().now()))
    if not as_json:
        click.echo(f"\n{file} is valid: no limit is violated.")
