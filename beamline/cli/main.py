"""The command `beamline`: imports the subcommand in use, maps errors to exit codes, and outlives a closed terminal."""

from __future__ import annotations

import errno
import io
import os
import sys
import warnings
from dataclasses import dataclass
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
from beamline.core.shipped import version
from beamline.core.text import printable, size

_CLOSED = (errno.EPIPE, errno.EBADF, errno.EINVAL)
"""Errors of a pipe without a reader (EINVAL on Windows). They are passed over: its reader has ended on purpose."""


class _Lasting(io.FileIO):
    """Accepts all output; after the first error it drops it."""

    error: OSError | None = None

    def write(self, data: Any, /) -> int:
        if self.error is None:
            try:
                return super().write(data)
            except OSError as error:
                self.error = error
        return memoryview(data).nbytes


class Outputs:
    """Puts `sys.stdout` and `sys.stderr` on files that last. Both, and stdin, are open from now on.

    The next file to be opened would get the number of a closed one (`>&-`): a scan file would receive printed text.
    Only `sys.stdout` leads to the results: what a library or a plug-in writes to the descriptor 1 goes to stderr.
    """

    def __init__(self) -> None:
        while (number := os.open(os.devnull, os.O_RDWR)) < 3:
            os.set_inheritable(number, True)
        os.close(number)
        sys.stdout = _lasting(sys.stdout, apart=True) or _nowhere()
        sys.stderr = _lasting(sys.stderr) or _nowhere()

    def lost(self) -> str:
        """Why stdout is incomplete; "" if it is complete, or its reader has closed it. Both are flushed."""
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        buffer = getattr(sys.stdout, "buffer", None)
        error = getattr(getattr(buffer, "raw", buffer), "error", None)
        return "" if error is None or error.errno in _CLOSED else error.strerror


def _lasting(stream: TextIO | None, apart: bool = False) -> TextIO | None:
    """The same stream without errors; the stream itself if the system has no file for it (console of Windows).

    Args:
        apart: by a descriptor of its own; the stream's leads to stderr from now on.
    """
    buffer = getattr(stream, "buffer", None)
    raw = getattr(buffer, "raw", buffer)  # unbuffered (`python -u`) it is the same
    if not (isinstance(stream, io.TextIOWrapper) and type(raw) is io.FileIO):
        return stream
    stream.flush()
    number = stream.fileno()
    if apart:
        number = os.dup(number)
        os.dup2(2, stream.fileno())
    lasting: Any = _Lasting(number, "w", closefd=False)
    return io.TextIOWrapper(
        lasting if raw is buffer else io.BufferedWriter(lasting),
        stream.encoding,
        stream.errors,
        line_buffering=stream.line_buffering,
        write_through=stream.write_through,
    )


def _nowhere() -> TextIO:
    return open(os.devnull, "w", encoding="utf-8")  # noqa: PTH123 - as long as the process


@dataclass(frozen=True)
class _Entry:
    """The module of a command and its help line, which `beamline --help` prints without importing it (and torch).

    Attributes:
        files: its results are files or moves; its output is only a summary.
    """

    module: str
    help: str
    files: bool = True


_COMMANDS = {
    "demo": _Entry("demo", "Run a simulated scan with live reconstruction; writes a volume and a report."),
    "check": _Entry("config", "Validate a configuration. Nothing moves.", files=False),
    "doctor": _Entry("doctor", "Check this computer: camera link, ports, disk, memory. Nothing moves.", files=False),
    "home": _Entry("home", "Search the stage's reference position. The stage turns."),
    "tune": _Entry("tune", "Take a few frames and say which exposure to take."),
    "align": _Entry("tune", "Take a pair of views and say axis, tilt and sharpness, with the corrections."),
    "scan": _Entry("scan", "Run a scan, or print its plan with --dry-run."),
    "runs": _Entry("runs", "List the runs in a folder: sample, frames, state, size, flags.", files=False),
    "watch": _Entry("watch", "Show a run in the browser while it goes on, and afterwards."),
    "ioc": _Entry("ioc", "Serve the running scan as EPICS process variables.", files=False),
    "pause": _Entry("control", "Pause a running scan, from another terminal: no view is lost."),
    "resume": _Entry("control", "Let a paused scan go on."),
    "stop": _Entry("control", "Stop a running scan cleanly, from another terminal."),
    "abort": _Entry("control", "Abort a running scan at once, from another terminal."),
    "simulate": _Entry("simulate", "Simulate a scan of a scene, with labels and truth."),
    "xafs": _Entry("xafs", "Find a material's absorption edge and the energy of its highest contrast."),
    "recon": _Entry("recon", "Reconstruct a scan, finished or still running."),
    "materials": _Entry("materials", "Fit the volume of each material to scans at several energies."),
    "batch": _Entry("batch", "Reconstruct many scans by one recipe; a table says what became of each."),
    "tradeoff": _Entry("tradeoff", "Compare methods and settings on a scan: quality against time and memory."),
    "study": _Entry("study", "Say what fewer views, narrower sectors, random angles or averaged views cost on a scan."),
    "view": _Entry("view", "Show one or two volumes in the browser: slices, histogram, profile, difference."),
    "segment": _Entry("segment", "Segment the particles of a volume: labels, sizes, places."),
    "bench": _Entry("bench", "Measure this machine: kernels, fits, quality against time, and acquisition."),
    "info": _Entry("files", "Describe a scan file or a volume.", files=False),
    "validate": _Entry("files", "Check a scan file or a volume against the rules of its format.", files=False),
    "recover": _Entry("files", "Make an ordinary scan file of one whose writer died."),
    "archive": _Entry("files", "Write a compressed copy of a scan file, compared with it frame by frame."),
    "monitor": _Entry("monitor", "Look at the frames of a scan file with the checks of the monitor.", files=False),
    "ingest": _Entry("files", "Copy any scan into one HDF5 scan, frame by frame."),
    "export": _Entry("export", "Copy a volume to another format, with grey values if wanted."),
    "voxelise": _Entry("model", "Fill voxels of any size and box from the Gaussians behind a volume."),
    "surface": _Entry("surface", "Write the surface of a volume, or of its Gaussians, as a watertight mesh."),
    "render": _Entry("model", "Project the Gaussians behind a volume: views at any angle."),
    "completion": _Entry("man", "Print the completion script of a shell.", files=False),
    "man": _Entry("man", "Print the manual page of a command.", files=False),
    "config": _Entry("config", "Print a configuration template, a complete configuration, or the schema.", files=False),
}


@dataclass(frozen=True)
class _Libraries:
    """What the libraries of some commands need, under a limit of addresses.

    Attributes:
        addresses: bytes that a command on a tiny scan takes at its peak, with one thread of BLAS, and a twentieth more;
            measured on Linux with two cores.
        early: modules that are otherwise loaded late, when data have taken the room.
    """

    commands: str
    addresses: int
    early: tuple[str, ...]


_LIBRARIES = (
    _Libraries(
        "demo recon materials batch tradeoff study bench voxelise render",
        1_850_000_000,
        ("scipy.linalg", "torch", "matplotlib.figure"),
    ),
    _Libraries("monitor scan tune align simulate", 1_350_000_000, ("scipy.linalg", "scipy.ndimage")),
    _Libraries("xafs view segment info validate archive ingest export surface", 800_000_000, ("scipy.linalg",)),
)


def _load_early(modules: tuple[str, ...]) -> None:
    """Load these libraries, and the compiler of kernels, before data take the room.

    OpenBLAS waits for ever where it gets no memory while it is loaded, and LLVM ends the process.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # each thread takes 40 MB of addresses
    for module in ("recon", *modules):  # recon first: where numba is there already, it uses no compiled kernels
        import_module(module)
    numba: Any = import_module("numba")
    numba.njit(_nothing)()


def _nothing() -> None:
    pass


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

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """As click does. DataError where a limit leaves no room for the libraries: some end the process then."""
        from beamline.core.machine import memory_limit  # here, so that the help loads without it

        libraries = next((each for each in _LIBRARIES if args and args[0] in each.commands.split()), None)
        if libraries is not None and (limit := memory_limit()) is not None:
            if limit < libraries.addresses:
                raise DataError(
                    f"Out of memory: this process may use {size(limit)} of address space (ulimit -v), and the "
                    f"libraries of `beamline {args[0]}` alone need {size(libraries.addresses)}. Nothing was read or "
                    "written."
                )
            _load_early(libraries.early)
        return super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, entry.help) for name, entry in _COMMANDS.items()])

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        names = [
            CompletionItem(name, help=entry.help) for name, entry in _COMMANDS.items() if name.startswith(incomplete)
        ]
        return names + click.Command.shell_complete(self, ctx, incomplete)

    def invoke(self, ctx: click.Context) -> Any:
        try:
            return super().invoke(ctx)
        except (Exit, Abort, ClickException):
            raise
        except BaseException as error:  # SystemExit, too, which is 0 by itself: no command of ours raises it
            message = user_message(error)
            if is_defect(error):
                if ctx.params.get("debug"):
                    raise
                left = leave_traceback(error, Path())
                message += f"; the traceback is in {left}" if left else "; --debug shows where"
                message += ". Please report it. What was written before is as it was written."
            click.echo(f"beamline: {printable(message)}", err=True)
            ctx.exit(exit_code(error))


_EXIT_CODES = """\b
Exit codes:
  0    done
  1    a defect of this program; the message names the file with its traceback
  2    wrong usage or configuration; nothing was started
  3    a device failed or did not answer
  4    stopped on request; the output holds the data so far
  5    data or disk: frames are missing, or a file cannot be read or written
  6    a quality limit failed
  7    the scan is complete, but the monitor raised alarms
  130  interrupted before there was a result, or aborted
"""


@click.group(cls=LazyGroup, epilog=_EXIT_CODES, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(version(), prog_name="beamline")
@click.option("--debug", is_flag=True, envvar="BEAMLINE_DEBUG", help="End with the traceback of a defect.")
def main(debug: bool) -> None:
    """X-ray micro-tomography from trigger to volume: acquire, monitor, reconstruct.

    Results go to stdout, messages and progress to stderr.
    """


def run() -> NoReturn:
    """Run the command as a process that always ends with its own exit code.

    HDF5 crashes at exit where a file could not be closed, as on a full disk: the code would be -11 instead of 5. A
    closed terminal, or a disk that takes no output, does not end a command: the rest of its output is lost.
    """
    warnings.simplefilter("ignore", RuntimeWarning)  # numpy's, of inf and NaN: such results are reported in words
    outputs, code = Outputs(), 0
    try:
        main(prog_name="beamline")
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else BeamlineError.exit_code if end.code else 0
    except KeyboardInterrupt:  # outside the work of a command, as while its result is printed
        code = INTERRUPTED
    exec("")  # else Python ends by SIGINT if Ctrl-C came in such a text, as dataclasses run, though it was caught
    if lost := outputs.lost():
        click.echo(f"beamline: the output on stdout is not whole ({lost}).", err=True)
        entry = _COMMANDS.get(next((word for word in sys.argv[1:] if not word.startswith("-")), ""))
        if code == 0 and (entry is None or not entry.files):
            code = DataError.exit_code
    if code and _holds_hdf5_files():
        os._exit(code)
    sys.exit(code)


def _holds_hdf5_files() -> bool:
    h5py = sys.modules.get("h5py")
    return h5py is not None and h5py.h5f.get_obj_count(h5py.h5f.OBJ_ALL, h5py.h5f.OBJ_ALL) > 0


if __name__ == "__main__":
    run()
