"""`beamline pause`, `resume`, `stop` and `abort`: verbs to a running scan from another terminal."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.config.models import Storage
from beamline.core.errors import ConfigError
from beamline.scan.control import Verb, running, tell

_RUN = click.argument("run", required=False, type=click.Path(path_type=Path, exists=True, file_okay=False))


@click.command()
@_RUN
def pause(run: Path | None) -> None:
    """Pause the scan in the folder RUN (the running one of ./runs): the stage stands, the shutter closes, and no view
    is lost or taken twice. `beamline resume` goes on.

    Exit code: 0 it was told, 2 no scan runs there or it does not answer, 5 disk error.
    """
    _tell(run, Verb.PAUSE)


@click.command()
@_RUN
def resume(run: Path | None) -> None:
    """Let the paused scan in the folder RUN (the running one of ./runs) go on.

    Exit code: 0 it was told, 2 no scan runs there or it does not answer, 5 disk error.
    """
    _tell(run, Verb.RESUME)


@click.command()
@_RUN
def stop(run: Path | None) -> None:
    """Stop the scan in the folder RUN (the running one of ./runs) cleanly, as the first Ctrl-C does.

    Exit code: 0 it was told, 2 no scan runs there or it does not answer, 5 disk error.
    """
    _tell(run, Verb.STOP)


@click.command()
@_RUN
def abort(run: Path | None) -> None:
    """Abort the scan in the folder RUN (the running one of ./runs) at once, as the second Ctrl-C does.

    Exit code: 0 it was told, 2 no scan runs there or it does not answer, 5 disk error.
    """
    _tell(run, Verb.ABORT)


def _tell(run: Path | None, verb: Verb) -> None:
    run = run or _only(Path(Storage.model_fields["folder"].default))
    click.echo(f"{run}: {tell(run, verb)}")


def _only(runs: Path) -> Path:
    """The one run in a folder that goes on."""
    found = running(runs)
    if len(found) == 1:
        return found[0]
    if found:
        raise ConfigError(f"{len(found)} scans run in {runs}: {', '.join(run.name for run in found)}. Name one.")
    raise ConfigError(f"no scan runs in {runs}. Name the folder of the run. Nothing was changed.")
