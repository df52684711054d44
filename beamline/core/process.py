"""Child processes: started in their own process group, read line by line, and ended within a time limit."""

from __future__ import annotations

import json
import math
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from enum import Enum, auto
from pathlib import Path
from typing import Any, Self, TextIO

import psutil

from beamline.core.errors import INTERRUPTED, ConfigError
from beamline.core.stop import StopScope

_POLL = 0.2  # real time in s between two checks whether the process should stop
SAFE_PATH = {"PYTHONSAFEPATH": "1"}
"""With this environment, a Python process, and Python processes that it starts, import nothing from the working
folder."""
ORPHANED = "this process ends, because the process that had started this one has died; no result was written"
_LAST_WORK = 20.0  # real s that an orphan may take to notice
_LAST_LINES = 5.0  # real s to read the last output of a killed process; its own child may hold the pipe open


# environment variable: the Python program that runs parts of a scan, if another program (a host) embeds Python
PYTHON = "BEAMLINE_PYTHON"


class NoPythonError(ConfigError, OSError):
    """No program was found that runs Python with the same packages as this process."""


def python() -> str:
    """The program that runs Python with the same packages as this process.

    If Python is embedded in a host, `sys.executable` is the host, or is empty. Starting the host would start all of it
    once more.

    Raises: NoPythonError: no such program was found.
    """
    inside = ("bin/python{}.{}".format(*sys.version_info), "python.exe", "Scripts/python.exe")
    candidates = [str(Path(prefix, name)) for prefix in (sys.prefix, sys.base_prefix) for name in inside]
    programs = [each or "" for each in (sys.executable, getattr(sys, "_base_executable", ""), *candidates)]
    ours = (each for each in programs if re.search("(?i)python|pypy", Path(each).name) and Path(each).is_file())
    if program := os.environ.get(PYTHON) or next(ours, None):
        return program
    raise NoPythonError(
        f"Set the environment variable {PYTHON} to a Python that has splatline, such as C:/Python313/python.exe. The "
        f"reason: Python runs inside another program here (sys.executable is {sys.executable!r}), and no stand-alone "
        f"Python was found in {sys.prefix}"
    )


class ProcessEnd(Enum):
    """The reason why a process ended."""

    EXITED = auto()
    STOPPED = auto()
    SILENT = auto()
    OUT_OF_TIME = auto()


class ChildProcess:
    """A running command. A separate thread passes each line of its stdout to `on_line`.

    Ctrl-C at the terminal does not reach the process: the caller decides when it ends. Use the object as a context
    manager; its end kills a process that is still running. A Python process imports nothing from the working folder,
    because a file such as recon.py there may be the user's.

    Args:
        command: program and arguments.
        stderr: open file for the stderr of the process. on_line: function that receives each line. environment:
            environment of the process; None: that of this process. tether: True: the process gets a stdin that stays
            open as long as this process lives, so that it notices when this process ends. on_end: function that is
            called after the last line, in the same thread. behind: True: the process gets less processor time than
            others (nice 10; Windows: the class below normal).

    Raises:
        OSError: the command cannot be started.
    """

    def __init__(
        self,
        command: Sequence[str],
        stderr: TextIO,
        on_line: Callable[[str], None],
        environment: Mapping[str, str] | None = None,
        *,
        tether: bool = False,
        on_end: Callable[[], None] = lambda: None,
        behind: bool = False,
    ) -> None:
        self._on_line, self._on_end = on_line, on_end
        if command[0] == sys.executable and (program := python()) != sys.executable:
            command, environment = [program, *command[1:]], with_our_path()
        self._silent_since = time.monotonic()
        self._process = subprocess.Popen(
            list(command),
            stdin=subprocess.PIPE if tether else subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**(os.environ if environment is None else environment), **SAFE_PATH},
            start_new_session=True,  # POSIX
            # Windows: a child without its own window would end when the console is closed.
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
            | (getattr(subprocess, "CREATE_NO_WINDOW", 0) if tether else 0),
        )
        if behind:
            with suppress(psutil.Error):  # the process has ended, or the system does not allow it
                child = psutil.Process(self._process.pid)
                child.nice(getattr(psutil, "BELOW_NORMAL_PRIORITY_CLASS", min(19, int(child.nice()) + 10)))
        name = f"output of process {self._process.pid}"
        self._reader = threading.Thread(target=self._read, name=name, daemon=True)
        self._reader.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.end()

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    @property
    def code(self) -> int | None:
        """Exit code of the process; None while it is running."""
        return self._process.poll()

    def wait(
        self,
        *,
        stop: Callable[[], bool] = lambda: False,
        hurry: Callable[[], bool] = lambda: False,
        seconds: float = math.inf,
        silence: float = math.inf,
        grace: float = 0.0,
    ) -> ProcessEnd:
        """Wait until the process has ended and all of its lines have been passed on.

        Args:
            stop: function that is called a few times a second; if it returns True, the process is ended. hurry:
                function that is called in the same way while the process is ending; if it returns True, the process is
                killed at once. seconds: real time in s after which the process is killed. silence: real time in s
                without a line, from now on, after which the process is ended. grace: real time in s between the request
                to end and the kill; 0 kills at once.
        """
        self._silent_since = time.monotonic()
        ending, deadline = ProcessEnd.EXITED, self._silent_since + seconds
        while self.running:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(max(0.0, min(_POLL, deadline - time.monotonic())))
                break
            now = time.monotonic()
            if now >= deadline:
                ending, grace = ProcessEnd.OUT_OF_TIME, 0.0
            elif stop():
                ending = ProcessEnd.STOPPED
            elif now - self._silent_since > silence:
                ending = ProcessEnd.SILENT
            else:
                continue
            self._end(grace, hurry)
        self._reader.join()
        self.let_go()
        return ending

    def tell(self, text: bytes = b".") -> None:
        """Write to the stdin of a tethered process. Any byte shows the process that this one is alive."""
        assert self._process.stdin is not None
        with suppress(OSError, ValueError):  # the process has ended
            os.write(self._process.stdin.fileno(), text)

    def become(self, line: str, on_line: Callable[[str], None], on_end: Callable[[], None]) -> None:
        """Send a line to a tethered process. From now on, pass its lines and its end to these functions."""
        self._on_line, self._on_end = on_line, on_end
        self.tell(f"{line}\n".encode())

    def end(self, grace: float = 0.0) -> None:
        """Ask the process to end. If it is still running after `grace` s of real time, kill it."""
        if self.running:
            self._end(grace, lambda: False)
            self._reader.join(_LAST_LINES)
        self.let_go()

    def _end(self, grace: float, hurry: Callable[[], bool]) -> None:
        if grace > 0:
            self._process.terminate()
            deadline = time.monotonic() + grace
            while (remaining := deadline - time.monotonic()) > 0 and not hurry():
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(min(_POLL, remaining))
                    return
        self._process.kill()
        self._process.wait()

    def let_go(self) -> None:
        """Close the stdin of a tethered process, as happens when this process ends."""
        if self._process.stdin is not None:
            with suppress(OSError):  # a line that the process has not read
                self._process.stdin.close()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                self._silent_since = time.monotonic()
                self._on_line(line)
        self._on_end()


def run_to_end(
    command: Sequence[str],
    log: Path,
    on_line: Callable[[str], None],
    silence: float = math.inf,
) -> tuple[ProcessEnd, int | None, str]:
    """Run a command with the same imports as this process. If an exception is raised here, the command is killed.

    Args:
        log: file for the stderr of the command. on_line: function that receives each line of its stdout. silence: real
            time in s without a line, after which the command is killed.

    Returns:
        Why it ended, its exit code, and the last line of its stderr.

    Raises:
        OSError: the log cannot be written, or the command cannot be started.
    """
    with (
        log.open("w", encoding="utf-8") as stderr,
        ChildProcess(command, stderr, on_line, with_our_path(), tether=True) as process,
    ):
        ending = process.wait(silence=silence)
    return ending, process.code, last_line(log)


def at_end_of(pipe: int, act: Callable[[], object], on_text: Callable[[bytes], object] = lambda text: None) -> None:
    """Call `act` in a separate thread when the file descriptor `pipe` reaches its end, because the process at the other
    end is dead. Until then, `told` gets the text that the other process writes.

    The thread uses raw reads. If it waited in a buffered read, it would hold a lock that the interpreter needs when it
    ends.
    """

    def wait() -> None:
        with suppress(OSError):
            while text := os.read(pipe, 65536):
                on_text(text)
        act()

    threading.Thread(target=wait, name="parent", daemon=True).start()


class EndsWithParent:
    """A stop scope of a tethered child process. It interrupts the work when the parent process has died.

    If the work does not ask in time whether to stop, the process ends after _LAST_WORK s of real time, wherever the
    work is.

    Args:
        scope: stop scope for all other reasons to end early. pipe: file descriptor that reaches its end when the parent
            ends.
    """

    def __init__(self, scope: StopScope, pipe: int) -> None:
        self._scope, self._orphaned = scope, threading.Event()
        at_end_of(pipe, self._end)

    @contextmanager
    def __call__(self) -> Iterator[Callable[[], bool]]:
        with self._scope() as stop_requested:

            def asked() -> bool:
                if self._orphaned.is_set():
                    raise KeyboardInterrupt(ORPHANED)
                return stop_requested()

            yield asked

    def _end(self) -> None:
        self._orphaned.set()
        time.sleep(_LAST_WORK)
        os._exit(INTERRUPTED)


def with_our_path() -> dict[str, str]:
    """The environment for a child process that imports the same modules as this process."""
    stated = os.environ.get("PYTHONPATH", "").split(os.pathsep)
    # The path contains the working folder if this process was started with `python -m`.
    path = [folder for folder in sys.path if folder and (folder != str(Path.cwd()) or folder in stated)]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(path)}


def last_line(log: Path) -> str:
    """The last line that a process wrote to a file; "" if there is no line."""
    lines = log.read_bytes().decode("utf-8", errors="replace").strip().splitlines()
    return lines[-1] if lines else ""


def json_object(line: str) -> dict[str, Any] | None:
    """The JSON object in a line of output; None for any other line, such as the output of a library."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):  # RecursionError: the JSON is nested deeper than Python's stack
        return None
    return value if isinstance(value, dict) else None
