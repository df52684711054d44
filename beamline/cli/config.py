"""`beamline config`: a template to edit, a configuration with everything filled in, and its schema."""

from __future__ import annotations

import json
from pathlib import Path

import click

from beamline.config.load import config_folder, load, resolved_yaml, schema

OVERRIDE_HELP = "Override a value, such as scan.period_s=0.2; may be repeated."


@click.group()
def config() -> None:
    """Make, show and describe configurations."""


@config.command(short_help="Print a configuration to edit.")
@click.option("--instrument", is_flag=True, help="For the real instrument instead of simulated devices.")
def init(instrument: bool) -> None:
    """Print a complete, commented configuration to edit: beamline config init > my.yaml"""
    name = "instrument.yaml" if instrument else "simulated.yaml"
    click.echo((config_folder() / name).read_text(encoding="utf-8"), nl=False)


@config.command(short_help="Print a configuration with everything filled in.")
@click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
@click.option("--set", "overrides", multiple=True, metavar="KEY=VALUE", help=OVERRIDE_HELP)
def show(file: Path, overrides: tuple[str, ...]) -> None:
    """Print CONFIG as a scan would use it: overrides and environment applied, every default filled in."""
    click.echo(resolved_yaml(load(file, overrides)), nl=False)


@config.command("schema", short_help="Print the JSON schema of a configuration.")
def print_schema() -> None:
    """Print the JSON schema of a configuration, for editors that complete and check while one types."""
    click.echo(json.dumps(schema(), indent=2))
