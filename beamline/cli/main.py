"""The command `beamline`: loads the subcommand in use, converts errors to exit codes, and continues if the terminal is
closed."""

from __future__ import annotations

import errno
import os
import re
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NoReturn, TextIO

import click
from click.exceptions import Abort, ClickException, Exit
from click.shell_completion import CompletionItem

from beamline.core.errors import (
    INTERRUPTED,
    BeamlineError,
    DataError,
    exit_code,
    is_defect,
    leave_traceback,
    user_message,
)
from beamline.core.installed import version
from beamline.core.text import printable
from recon.base.registry import ADD_ONS, Registry, add_on_missing, did_you_mean, tables_in_folders
from recon.compiled import use_compiled_kernels


@dataclass(frozen=True)
class CommandEntry:
    """A command: the module that defines it, and its one-line summary in `beamline --help`.

    Attributes:
        module: the module with the command. Its function has the name of the command, with "_" for "-".
        files: True if the results are files or movements. The printed output is then only a summary.
        command: the command itself, if it comes from another package (which is then loaded).
    """

    module: str
    help: str
    files: bool = True
    command: click.Command | None = None

    def load(self, name: str) -> click.Command:
        if self.command is not None:
            return self.command
        command: click.Command = getattr(import_module(self.module), name.replace("-", "_"))
        return command


CORE = {
    "check": CommandEntry(
        "beamline.cli.control", "Check a configuration and print the plan of its scan. Nothing moves.", files=False
    ),
    "home": CommandEntry("beamline.cli.control", "Turn the stage to its reference mark. THE STAGE TURNS."),
    "scan": CommandEntry("beamline.cli.scan", "Run a scan and reconstruct it; --dry-run prints only the plan."),
    "pause": CommandEntry(
        "beamline.cli.control", "Pause a running scan (from another terminal). No projection is lost."
    ),
    "resume": CommandEntry("beamline.cli.control", "Continue a paused scan (from another terminal)."),
    "stop": CommandEntry("beamline.cli.control", "Stop a running scan cleanly (from another terminal)."),
    "abort": CommandEntry("beamline.cli.control", "Abort a running scan immediately (from another terminal)."),
    "decide": CommandEntry(
        "beamline.cli.control", "Tell a scan that waits for your decision what to measure next (from another terminal)."
    ),
    "recon": CommandEntry("beamline.cli.recon", "Reconstruct a scan, finished or still running, and write a report."),
    "recover": CommandEntry(
        "beamline.cli.control", "Repair the file of a scan whose process was killed, so that any program can read it."
    ),
    "monitor": CommandEntry(
        "beamline.cli.monitor", "Check every frame of a scan file, as the monitor does during a scan.", files=False
    ),
    "config": CommandEntry(
        "beamline.cli.control",
        "Print a configuration to edit, a configuration with all defaults, or the JSON schema.",
        files=False,
    ),
}
"""The commands that acquire, check and reconstruct scans, in the order of the help."""


@cache
def feature_commands() -> dict[str, CommandEntry]:
    """The commands of the folders in `beamline.features`, in the order of the folders' names.

    COMMANDS of a folder has the help line and `CommandEntry.files` of each command. The commands are in the folder's
    module `command`.
    """
    return {
        name: CommandEntry(f"beamline.features.{folder}.command", help_line, files)
        for folder, rows in tables_in_folders("beamline.features", "COMMANDS").items()
        for name, (help_line, files) in rows.items()
    }


def own_commands() -> dict[str, CommandEntry]:
    """All commands of this package; those of the core come first."""
    return {**CORE, **feature_commands()}


@cache
def commands() -> Registry[CommandEntry]:
    """All commands. Other packages are searched only for a name that this package does not have."""
    return Registry("command", own_commands(), _entry_of)


def _entry_of(name: str, command: object) -> CommandEntry:
    """The entry of a command of another package."""
    if not isinstance(command, click.Command):
        raise ValueError(f"it is a {type(command).__name__}; expected a click.Command")
    return CommandEntry("", command.get_short_help_str(100), command=command)


_CLOSED = (errno.EPIPE, errno.EBADF, errno.EINVAL)
"""Errors of a pipe without a reader (EINVAL on Windows). They are ignored, because the reader has ended on purpose."""


class _Lasting:
    """A text stream that accepts all text. After the first error, it drops the text."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream
        self.error: OSError | None = None

    def _tried(self, work: Callable[..., Any], *arguments: Any) -> None:
        try:
            work(*arguments)
        except OSError as error:
            self.error = error
            os.dup2(os.open(os.devnull, os.O_RDWR), self._stream.fileno())  # buffered text goes there, too

    def write(self, text: str) -> int:
        self._tried(self._stream.write, text)
        return len(text)

    def flush(self) -> None:
        self._tried(self._stream.flush)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


class _Printable:
    """A text stream that replaces control characters in names and texts from outside the program by visible text, so
    that the terminal does not act on them.

    `unfiltered` is the original stream, which a progress bar needs.
    """

    def __init__(self, stream: _Lasting) -> None:
        self.unfiltered = stream

    def write(self, text: str) -> int:
        return self.unfiltered.write(printable(text) if isinstance(text, str) else text)  # click tries bytes

    def __getattr__(self, name: str) -> Any:
        return getattr(self.unfiltered, name)


def guard_streams() -> None:
    """Replace `sys.stdout` and `sys.stderr` by streams that survive a closed terminal and print no control characters.
    If stdin, stdout or stderr was closed, it is opened.

    If one of them stayed closed (`>&-`), the next file that is opened would get its number, and printed text would go
    into a scan file. Text that another library prints to stdout, even at the end of the process, goes to stderr. With
    `--json` it is dropped, because it is not JSON. If colorama is installed (on Windows, click requires it), numba
    usually loads it, and colorama prints a control sequence at the end of the process. Here numba is prevented from
    loading it.
    """
    os.environ.setdefault("NUMBA_DISABLE_ERROR_MESSAGE_HIGHLIGHTING", "1")
    while (number := os.open(os.devnull, os.O_RDWR)) < 3:
        os.set_inheritable(number, True)
    os.close(number)
    streams: Any = sys  # typeshed knows only text files as streams
    # and not an object that a host program put there
    if getattr(out := sys.stdout or _nowhere(), "name", "") == "<stdout>":
        out = open(  # noqa: SIM115
            os.dup(1),
            "w",
            1 if out.isatty() else -1,
            out.encoding,
            # a code page of Windows does not have all letters
            "backslashreplace" if out.errors == "strict" else out.errors,
            closefd=False,
        )
        os.dup2(os.open(os.devnull, os.O_WRONLY) if "--json" in sys.argv else 2, 1)
    streams.stdout = _Printable(_Lasting(out))
    streams.stderr = _Printable(_Lasting(sys.stderr or _nowhere()))


def lost_output() -> str:
    """Flush stdout and stderr. Returns why stdout is incomplete; "" if it is complete, or if its reader has closed
    it."""
    for stream in (sys.stdout, sys.stderr):
        stream.flush()
    error: OSError | None = getattr(sys.stdout, "error", None)
    return "" if error is None or error.errno in _CLOSED else str(error.strerror)


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123 - as long as the process


def _command(name: str) -> CommandEntry | None:
    """The command of this name. Other packages are searched only if this package has no such command, because the
    search takes a tenth of a second."""
    return own_commands().get(name) or commands().get(name)


_GONE = {"segment": ", which was removed: use `beamline structure VOLUME` instead (pip install splatline-structure)"}


class LazyGroup(click.Group):
    """A group that imports a command's module when the command is used."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(commands())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        command = _command(cmd_name)
        return None if command is None else command.load(cmd_name)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Resolve a command as click does. The error for an unknown name suggests the most similar name.

        If another package adds a command of two words, such as `study structure`, both words are its name.
        """
        if args[:1] == ["doctor"]:  # the name of the command in version 1.0
            click.echo("`beamline doctor` is now `beamline check CONFIG --connect`.", err=True)
            args = ["check", "--connect", *(word for word in args[1:] if word != "--session")]
        if (two := " ".join(args[:2])) in ADD_ONS:
            args = [two, *args[2:]]
        command = _command(args[0]) if args else None
        if args and command is None and args[0][:1] not in ("", "-"):
            if args[0] in ADD_ONS:
                ctx.fail(f"`beamline {args[0]}` {add_on_missing(args[0])}.")
            ctx.fail(f"There is no command {args[0]!r}{_GONE.get(args[0]) or did_you_mean(args[0], commands())}.")
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        features = [(name, command.help) for name, command in commands().items() if name not in CORE]
        with formatter.section("Commands"):
            formatter.write_dl([(name, command.help) for name, command in CORE.items()])
        if features:
            with formatter.section("More commands"):
                formatter.write_dl(features)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        names = [
            CompletionItem(name, help=each.help) for name, each in commands().items() if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (Exit, Abort, ClickException):
            raise
        except (
            BaseException
        ) as error:  # SystemExit, too, because no command of ours raises it; its own exit code could be 0
            message = user_message(error)
            if is_defect(error):
                if ctx.params.get("debug"):
                    raise
                traceback_path = leave_traceback(error, Path())
                message += f"; the traceback is in {traceback_path}" if traceback_path else "; --debug shows where"
                message += ". Please report it. Files written before the error are unchanged."
            # A line end without an indent after it belongs to the name of a file.
            click.echo("beamline: " + printable(re.sub(r"\n(?! )", " ", message)), err=True)
            ctx.exit(exit_code(error))


_EXIT_CODES = """\b
Exit codes:
  0    done
  1    a defect of this program; the message names the file with its traceback
  2    wrong usage, configuration or installation; nothing was started
  3    a device failed or did not answer
  4    stopped on request; the output holds the data so far
  5    data or disk: frames are missing, or a file cannot be read or written
  6    a quality limit failed
  7    the scan is complete, but the monitor raised alarms
  130  interrupted before there was a result, or aborted
"""
_MOST_THREADS = 4096  # numba starts all of its threads, and if the system does not allow one of them, the process ends


@click.group(cls=LazyGroup, epilog=_EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="beamline")
@click.option(
    "--debug",
    is_flag=True,
    envvar="BEAMLINE_DEBUG",
    help="Print the full Python traceback if a defect ends the program.",
)
def main(debug: bool) -> None:
    """Run X-ray micro-tomography scans, check every frame, and reconstruct them.

    \b
    beamline demo             scan and reconstruct a simulated battery
    beamline recon SCAN.h5    reconstruct your own scan
    beamline COMMAND --help   what a command does, an example, and its options

    Results go to stdout, messages and progress to stderr.
    """
    threads = os.environ.get("NUMBA_NUM_THREADS", "1").strip()
    if not (threads.isdecimal() and 0 < int(threads) <= _MOST_THREADS):
        raise click.UsageError(
            f"NUMBA_NUM_THREADS={threads} in the environment; expected a number of threads, 1 to {_MOST_THREADS}."
        )


def run() -> NoReturn:
    """Run the command as a process that always ends with its own exit code.

    HDF5 crashes at exit if a file could not be closed, for example on a full disk. The exit code would then be -11
    instead of 5. If the terminal is closed or the disk accepts no output, the command continues, and the rest of its
    output is lost.
    """
    # numpy's warnings about inf and NaN; the program reports such results in words
    warnings.simplefilter("ignore", RuntimeWarning)
    warnings.showwarning = lambda message, *_: click.echo(f"Warning: {message}", err=True)
    # the backend of a notebook that started this process may be missing here, and matplotlib would stop with an error
    os.environ["MPLBACKEND"] = "agg"
    if os.environ.pop("NUMBA_DISABLE_JIT", None):  # as plain Python, kernels take hours, and some cannot run
        use_compiled_kernels()
    guard_streams()
    code = 0
    try:
        main(prog_name="beamline")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else BeamlineError.exit_code if end.code else 0
    except KeyboardInterrupt:  # outside the work of a command, for example while its result is printed
        code = INTERRUPTED
    # otherwise Python ends by SIGINT if Ctrl-C came while generated code (as in dataclasses) ran, although it was
    # caught
    exec("")
    if lost := lost_output():
        click.echo(f"beamline: the output on stdout is incomplete ({lost}).", err=True)
        command = _command(next((word for word in sys.argv[1:] if not word.startswith("-")), ""))
        if code == 0 and (command is None or not command.files):
            code = DataError.exit_code
    if code and _holds_hdf5_files():
        os._exit(code)
    sys.exit(code)


def _holds_hdf5_files() -> bool:
    h5py = sys.modules.get("h5py")
    return h5py is not None and h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_ALL) > 0


if __name__ == "__main__":
    run()
