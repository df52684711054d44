"""Runs each trial in a process of its own, ends it in time, and turns its output into an outcome."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter

from beamline.core.errors import DataError
from beamline.core.files import named_on_failure
from beamline.core.process import ChildProcess, ProcessEnd, json_object, last_line, with_our_path
from beamline.features.trials.trial import Outcome, Status, Trial

DATA = "data"
"""Name of the folder with the `TrialData` that all trials read, in the folder of the results."""


@dataclass(frozen=True)
class TrialJob:
    """What a process is to do.

    Attributes:
        data: folder of `TrialData`.
        trial: to run; None: only kernels are compiled.
        keep: a .npy file for the volume [z, y, x]; None: it is measured and forgotten.
        compiled: trials whose kernels are compiled.
    """

    data: Path
    trial: Trial | None = None
    seed: int = 0
    keep: Path | None = None
    compiled: Sequence[Trial] = ()


JOB = TypeAdapter(TrialJob)
"""Reads and writes a job as JSON."""


def command(job: Path) -> Sequence[str]:
    """The command that runs the job in the file `job`."""
    return [sys.executable, "-m", "beamline.features.trials.worker", str(job)]


def compile_kernels(trials: Sequence[Trial], work: Path, max_seconds: float | None = None) -> None:
    """Fill the cache of compiled kernels for these trials, so that no trial's memory includes the compiler's.

    Args:
        work: a folder with the data, `DATA`.
        max_seconds: after which it is ended; what is missing is compiled by the trials. None: no limit.
    """
    kinds = {_kernels(trial): trial for trial in trials}
    job = TrialJob(work / DATA, compiled=tuple(kinds.values()))
    _run(job, work, max_seconds)  # a failure here comes again in a trial, which reports it


def _kernels(trial: Trial) -> tuple[str, ...]:
    """A trial's method and its settings that are words: they decide which kernels it compiles."""
    return trial.method, *(value for value in trial.settings.values() if isinstance(value, str))


def run_trial(
    trial: Trial, work: Path, seed: int, max_seconds: float | None = None, keep: Path | None = None
) -> Outcome:
    """Run one trial in a process of its own, which has ended when this returns or raises.

    Args:
        work: a folder with the data, `DATA`.
        max_seconds: after which the process is killed; None: no limit.
        keep: a .npy file for its volume [z, y, x]; None: the volume is forgotten.

    Raises:
        DataError: the disk did not take the job or the volume: trials to come would fail, too.
    """
    return _outcome(trial, _run(TrialJob(work / DATA, trial, seed, keep), work, max_seconds))


@dataclass(frozen=True)
class _Ended:
    """A process that has ended: its last event, its exit code, the last line of its stderr, and whether its time was
    over."""

    event: Mapping[str, Any]
    code: int | None
    last_line: str
    out_of_time: bool


def _run(job: TrialJob, work: Path, max_seconds: float | None = None) -> _Ended:
    path, log = work / "job.json", work / "stderr.txt"
    with named_on_failure(path):
        path.write_bytes(JOB.dump_json(job))
    last: dict[str, Any] = {}

    def remember(line: str) -> None:
        nonlocal last
        last = json_object(line) or last

    with (
        log.open("w", encoding="utf-8") as stderr,
        ChildProcess(command(path), stderr, remember, with_our_path(), tether=True) as process,
    ):
        ending = process.wait(seconds=math.inf if max_seconds is None else max_seconds)
    return _Ended(last, process.code, last_line(log), ending is ProcessEnd.OUT_OF_TIME)


def _outcome(trial: Trial, ended: _Ended) -> Outcome:
    event = dict(ended.event)
    if event.pop("event", None) == "result":
        curve = [(float(s), float(q)) for s, q in event.pop("curve", [])]
        return Outcome(trial, "done", curve=tuple(curve), **event)
    status: Status = "out of time" if ended.out_of_time else "failed"
    if ended.out_of_time:
        return Outcome(trial, status, message="ended: the time given with --max-seconds was over")
    default = f"its process ended with code {ended.code}" + (f": {ended.last_line}" if ended.last_line else "")
    message = str(event.get("message", default))
    if ended.code == DataError.exit_code:
        raise DataError(message)
    return Outcome(trial, status, math.nan, message=message)
