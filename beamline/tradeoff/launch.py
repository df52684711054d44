"""A trial from outside: its process begun, listened to, ended in time; what became of it as an outcome."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from beamline.core.files import named_on_failure
from beamline.tradeoff.trials import Outcome, Status, Trial


def command(job: Path) -> Sequence[str]:
    """What runs the job in the file `job`."""
    return [sys.executable, "-m", "beamline.tradeoff.worker", str(job)]


def compile_kernels(trials: Sequence[Trial], work: Path) -> None:
    """Fill the cache of compiled kernels for these trials, so that no trial's memory is that of a compiler.

    Args:
        work: a folder with data.npz.
    """
    kinds = {(trial.method, trial.start): trial for trial in trials if trial.group != "precision"}
    job = {"data": str(work / "data.npz"), "compile": [asdict(trial) for trial in kinds.values()]}
    _process(job, work)  # what fails here, a trial will tell


def run_trial(trial: Trial, work: Path, seed: int, max_seconds: float | None = None) -> Outcome:
    """One trial in its own process; it is gone when this returns, whatever ended it.

    Args:
        work: a folder with data.npz.
        max_seconds: after which it is ended.
    """
    job = {"data": str(work / "data.npz"), "trial": asdict(trial), "seed": seed}
    return _outcome(trial, _process(job, work, max_seconds))


@dataclass(frozen=True)
class _Ended:
    """A process that has ended: the last thing it said, its code, its last words, and whether its time was over."""

    said: Mapping[str, Any]
    code: int
    words: str
    late: bool


def _process(job: Mapping[str, Any], work: Path, max_seconds: float | None = None) -> _Ended:
    path, words = work / "job.json", work / "stderr.txt"
    with named_on_failure(path):
        path.write_text(json.dumps(job), encoding="utf-8")
    late = threading.Event()
    with words.open("w", encoding="utf-8") as stderr:
        process = subprocess.Popen(
            command(path),
            stdin=subprocess.PIPE,  # by whose end it knows that this process is gone
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
            encoding="utf-8",
            errors="replace",
            env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            start_new_session=True,  # Ctrl-C is for this process, which decides what becomes of that one
            creationflags=getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
        )

        def end() -> None:
            late.set()
            process.kill()

        alarm = None if max_seconds is None else threading.Timer(max_seconds, end)
        if alarm is not None:
            alarm.start()
        last: Mapping[str, Any] = {}
        try:
            assert process.stdout is not None
            for line in process.stdout:
                last = _said(line) or last
            process.wait()
        finally:
            if alarm is not None:
                alarm.cancel()
            process.kill()
            process.wait()
            for pipe in (process.stdin, process.stdout):
                if pipe is not None:
                    pipe.close()
    return _Ended(last, process.returncode, words.read_text(encoding="utf-8", errors="replace"), late.is_set())


def _said(line: str) -> Mapping[str, Any] | None:
    try:
        said = json.loads(line)
    except ValueError:
        return None  # a library's print
    return said if isinstance(said, dict) else None


def _outcome(trial: Trial, ended: _Ended) -> Outcome:
    said = dict(ended.said)
    if said.pop("event", None) == "result":
        curve = [(float(s), float(q)) for s, q in said.pop("curve", [])]
        return Outcome(trial, "done", curve=tuple(curve), **said)
    status: Status = "out of time" if ended.late else "failed"
    if ended.late:
        return Outcome(trial, status, message="ended: the time given with --max-seconds was over")
    lines = ended.words.strip().splitlines()
    default = f"its process ended with code {ended.code}" + (f": {lines[-1]}" if lines else "")
    return Outcome(trial, status, math.nan, message=str(said.get("message", default)))
