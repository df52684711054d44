"""The command `beamline`: finds its commands by name, loads only the one asked for, and turns errors into exit codes.

Exit codes: 0 done; 1 defect (with a traceback); 2 usage or configuration; 3 device; 4 stopped with reduced data;
5 data or disk; 6 finished but a quality limit failed; 130 interrupted.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from importlib import import_module
from typing import Any, NoReturn

import click

from beamline.errors import INTERRUPTED, BeamlineError, DataError, InstrumentError
from beamline.version import version
from drivers.errors import DeviceError


@dataclass(frozen=True)
class _Entry:
    """Where a command lives. Its help line stands here so that `beamline --help` need not import it (and torch)."""

    module: str
    help: str


_COMMANDS = {
    "demo": _Entry("demo", "Simulated scan with live reconstruction, ending in a volume and a report."),
    "check": _Entry("check", "Validate a configuration; nothing moves."),
    "scan": _Entry("scan", "Run a scan (or, with --dry-run, say what it would do)."),
    "recon": _Entry("recon", "Reconstruct a scan, finished or still growing."),
    "info": _Entry("files", "Say what a scan file holds."),
    "validate": _Entry("files", "Check a scan file against the rules that readers rely on."),
    "ingest": _Entry("files", "Turn a multi-page TIFF into an HDF5 scan, page by page."),
    "config": _Entry("config", "Make, show and describe configurations."),
}


def _fail(ctx: click.Context, message: str, exit_code: int) -> NoReturn:
    click.echo(f"beamline: {message}", err=True)
    ctx.exit(exit_code)


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
        except BeamlineError as error:
            _fail(ctx, str(error), error.exit_code)
        except DeviceError as error:
            _fail(ctx, str(error), InstrumentError.exit_code)
        except KeyboardInterrupt:
            _fail(ctx, "interrupted.", INTERRUPTED)
        except OSError as error:
            # A closed pipe (`beamline info x | head`) is click's to handle; an OSError without a number is a defect.
            if error.errno is None or error.errno == errno.EPIPE:
                raise
            _fail(ctx, f"{error}. Check the path, the permissions and the disk.", DataError.exit_code)


@click.group(cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="beamline")
def main() -> None:
    """X-ray micro-tomography from trigger to volume: acquire, watch, reconstruct.

    Results go to stdout, narration and progress to stderr.
    """


if __name__ == "__main__":
    main(prog_name="beamline")
