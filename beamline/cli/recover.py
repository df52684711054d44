"""`beamline recover`: an ordinary scan file of one whose writer died."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.options import json_events, json_option
from beamline.core.events import Done
from beamline.core.stop import terminated_like_interrupted
from drivers.base.clock import SystemClock


@click.command()
@click.argument("file", type=click.Path(path_type=Path))
@json_option
def recover(file: Path, as_json: bool) -> None:
    """Make an ordinary scan file of FILE, whose writer died, in its place; of the folder of a run, of all its files.

    Every frame that was committed is kept; a frame that was being written is cut off. The file then opens in any
    program, has its /exchange view and the status `failed`. A file that is in order is left as it is. It can be
    run again after whatever stopped it, needs no room for a copy, and says what room it needs.
    """
    from beamline.core.files import SCAN
    from beamline.scan.resume import recover_run
    from beamline.storage.parts import JOINED
    from beamline.storage.recover import recover as recover_scan

    def say(what: str) -> None:
        click.echo(what, err=True)

    with terminated_like_interrupted(), json_events(as_json) as sink:
        run = file.parent if file.name == JOINED and (file.parent / SCAN).is_file() else file
        recovered, left_out = recover_run(run, say) if run.is_dir() else ([recover_scan(file, say)], [])
        for sentence in left_out:
            click.echo(f"Warning: {sentence}", err=True)
        for done in recovered:
            sink(Done(done, time=SystemClock().now()))
    if not as_json:
        click.echo("\n".join(done.in_words() for done in recovered))
