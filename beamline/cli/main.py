"""The command `beamline`: finds its commands by name, loads only the one asked for, and turns errors into exit codes.

Exit codes: 0 done; 1 defect (with a traceback); 2 usage or configuration; 3 device; 4 stopped with reduced data;
5 data or disk; 6 finished but a quality limit failed; 130 interrupted.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

import click

from beamline.core.errors import BeamlineError, exit_code, in_words
from beamline.core.version import version


@dataclass(frozen=True)
class _Entry:
    """Where a command lives. Its help line stands here so that `beamline --help` need not import it (and torch)."""

    module: str
    help: str


_COMMANDS = {
    "demo": _Entry("demo", "Simulated scan with live reconstruction, ending in a volume and a report."),
    "check": _Entry("check", "Validate a configuration; nothing moves."),
    "doctor": _Entry("doctor", "Look at this computer: camera link, ports, disk, memory; nothing moves."),
    "home": _Entry("home", "Search the stage's reference; the stage turns."),
    "scan": _Entry("scan", "Run a scan (or, with --dry-run, say what it would do)."),
    "simulate": _Entry("simulate", "Frames of a scene without an instrument: file, labels, truth, cost."),
    "xafs": _Entry("xafs", "At which energy a material stands out most: absorption edge, white line, contrast."),
    "recon": _Entry("recon", "Reconstruct a scan, finished or still growing."),
    "tradeoff": _Entry("tradeoff", "What accuracy costs in time: many reconstructions of a scan, compared."),
    "bench": _Entry("bench", "Measure this machine: kernels, fits, and the quality they give in a time."),
    "info": _Entry("files", "Say what a scan file holds."),
    "validate": _Entry("files", "Check a scan file against the rules that readers rely on."),
    "ingest": _Entry("files", "Turn a multi-page TIFF into an HDF5 scan, page by page."),
    "config": _Entry("config", "Make, show and describe configurations."),
}


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(_COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        entry = _COMMANDS.get(cmd_name)
        if entry is None:
            return None
        command: click.Command = getattr(import_module(f"beamline.cli.{entry.module}"), cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in _COMMANDS.items()])

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (Exception, KeyboardInterrupt) as error:
            code = exit_code(error)
            if code == BeamlineError.exit_code and not isinstance(error, BeamlineError):
                raise  # a defect, or click's own
            click.echo(f"beamline: {in_words(error)}", err=True)
            ctx.exit(code)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="beamline")
def main() -> None:
    """X-ray micro-tomography from trigger to volume: acquire, watch, reconstruct.

    Results go to stdout, narration and progress to stderr.
    """


def run() -> NoReturn:
    """The command as a process: what ends it is its exit code, whatever state a full disk left HDF5 in.

    HDF5 crashes at the end of a process that holds a file which could not be closed; that code would be -11, not 5.
    """
    try:
        main(prog_name="beamline")
    except SystemExit as end:
        if end.code and _holds_hdf5_files():
            sys.stdout.flush()
            sys.stderr.flush()
            os._exit(end.code if isinstance(end.code, int) else BeamlineError.exit_code)
        raise
    sys.exit(0)


def _holds_hdf5_files() -> bool:
    h5py = sys.modules.get("h5py")
    return h5py is not None and h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_ALL) > 0


if __name__ == "__main__":
    run()
