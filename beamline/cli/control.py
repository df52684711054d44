"""`beamline pause`, `resume`, `stop` and `abort`: verbs to a running scan from another terminal."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.core.errors import ConfigError

_EXIT_CODES = "Exit code: 0 it was told, 2 no scan runs there or it does not answer, 5 disk error."


def _command(verb: str, help_text: str) -> click.Command:
    """The command of a `beamline.scan.control.Verb`; `help_text` begins its help."""

    @click.command(verb, help=f"{help_text}\n\n{_EXIT_CODES}")
    @click.argument("run", required=False, type=click.Path(path_type=Path))
    def send(run: Path | None) -> None:
        from beamline.config.models import StorageSection  # here: help does not need it
        from beamline.scan.control import Verb, tell

        runs = Path(StorageSection.model_fields["folder"].default)
        if run is not None and not run.is_dir():
            raise ConfigError(f"there is no folder {run}; {_running_in(runs)}. Nothing was changed.")
        run = run or _only(runs)
        click.echo(f"{run}: {tell(run, Verb(verb))}")

    return send


pause = _command(
    "pause",
    "Pause the scan in the folder RUN (the running one of ./runs). The stage stands, the shutter closes, and no view "
    "is lost or taken twice. `beamline resume` goes on.",
)
resume = _command("resume", "Let the paused scan in the folder RUN (the running one of ./runs) go on.")
stop = _command(
    "stop", "Stop the scan in the folder RUN (the running one of ./runs) cleanly, as the first Ctrl-C does."
)
abort = _command(
    "abort", "Abort the scan in the folder RUN (the running one of ./runs) at once, as the second Ctrl-C does."
)


def _running_in(runs: Path) -> str:
    """Which scans run in a folder, without a full stop."""
    from beamline.scan.control import running

    names = [run.name for run in running(runs)]
    if not names:
        return f"no scan runs in {runs}"
    return f"{len(names)} {'scan runs' if len(names) == 1 else 'scans run'} in {runs}: {', '.join(names)}"


def _only(runs: Path) -> Path:
    """The one run in a folder that goes on."""
    from beamline.scan.control import running

    running_scans = running(runs)
    if len(running_scans) == 1:
        return running_scans[0]
    raise ConfigError(f"{_running_in(runs)}. Name the folder of the run. Nothing was changed.")
