"""Commands on hostile inputs, one after the other in a process of their own, which is killed where one does not end."""

import multiprocessing
import os
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import Any, Self

import psutil

_PATIENCE = 60  # real s
DOCUMENTED = {0, 2, 3, 4, 5, 6, 7, 130}
"""Exit codes of what is no defect."""


@dataclass(frozen=True)
class Ended:
    """How a command ended. `code` None: not within its time; "died": the process did."""

    code: int | str | None
    output: str
    trace: str = ""

    @property
    def good(self) -> bool:
        return self.code in DOCUMENTED and not self.trace and "Traceback" not in self.output


def _serve(pipe: Connection) -> None:
    import logging

    from click.testing import CliRunner

    from beamline.cli.main import main

    sys.stderr = open(os.devnull, "w")  # noqa: PTH123, SIM115 - h5py complains there of objects that it cannot close
    logging.disable(logging.CRITICAL)
    while (arguments := pipe.recv()) is not None:
        result = CliRunner().invoke(main, arguments, env={"BEAMLINE_DEBUG": "1"})
        trace = ""
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            trace = "".join(traceback.format_exception(result.exception))
        pipe.send(Ended(result.exit_code, result.output, trace))


class Worker:
    """A process that runs commands, made anew where it died or was killed."""

    def __init__(self, seconds: float, warm: Sequence[Sequence[str]] = (("info", "--help"),)) -> None:
        """Commands may take so many s of the processor's time; those of `warm` load what the others need."""
        self._seconds, self._warm = seconds, warm
        self._process: Any = None
        self._context = multiprocessing.get_context("spawn")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._end()

    def run(self, *arguments: str) -> Ended:
        if self._process is None:
            self._pipe, theirs = self._context.Pipe()
            self._process = self._context.Process(target=_serve, args=(theirs,), daemon=True)
            self._process.start()
            theirs.close()
            for warm in self._warm:
                self._pipe.send([*warm])
                self._pipe.recv()
        spent = self._spent()
        self._pipe.send(list(arguments))
        try:
            for _ in range(_PATIENCE):  # one that waits for something spends no time
                if self._pipe.poll(1.0):
                    return self._pipe.recv()
                if self._spent() - spent > self._seconds:
                    break
            ended = Ended(None, "")
        except (EOFError, ConnectionError):
            self._process.join()
            ended = Ended("died", f"exit code {self._process.exitcode}")
        self._end()
        return ended

    def _spent(self) -> float:
        try:
            times = psutil.Process(self._process.pid).cpu_times()
        except psutil.NoSuchProcess:
            return 0.0
        return float(times.user + times.system)

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.join()
            self._pipe.close()
            self._process = None
