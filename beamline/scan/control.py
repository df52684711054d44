"""Control: verbs to a running scan from another terminal.

A verb is an empty file of that name in the folder `control` of the run, which only its owner can write to; the scan
takes it away and does it. So it works on every system and file system, no port is open, and nothing is parsed.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from enum import StrEnum
from pathlib import Path

from beamline.core.errors import ConfigError, DataError
from beamline.core.files import EVENTS, parts_of
from beamline.core.stop import PauseRequest, StopRequest
from beamline.scan.run_folder import CONTROL, SCAN
from beamline.scan.states import State
from beamline.storage.writer_lock import held

_POLL = 0.1  # real s between looks
_ANSWER = 5.0  # real s within which a scan takes a verb away
_EFFECT = 20.0  # real s within which most verbs have been done: a stage has braked, a frame is exposed


class Verb(StrEnum):
    """What a running scan can be told, most urgent first."""

    ABORT = "abort"
    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"


@contextmanager
def verbs_taken(folder: Path, stop: StopRequest, pause: PauseRequest) -> Iterator[None]:
    """While the context lasts, verbs for the run in this folder are taken and done.

    Raises:
        DataError: the disk does not take the folder for them.
    """
    requests, over = folder / CONTROL, threading.Event()
    actions: Mapping[Verb, Callable[[], None]] = {
        Verb.ABORT: stop.abort, Verb.STOP: stop.stop, Verb.PAUSE: pause.pause, Verb.RESUME: pause.resume,
    }  # fmt: skip

    def take_verbs() -> None:
        while not over.wait(_POLL):
            for verb, action in actions.items():
                if _taken(requests / verb):
                    action()

    try:
        requests.mkdir(mode=0o700)
    except OSError as error:
        raise DataError(f"{requests} cannot be made ({error.strerror}). Nothing has moved or was acquired.") from error
    thread = threading.Thread(target=take_verbs, name="control", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(_ANSWER)
        with suppress(OSError):
            for verb in Verb:
                _taken(requests / verb)
            requests.rmdir()


def _taken(request: Path) -> bool:
    """Take a request away; False where there is none."""
    try:
        request.unlink()
    except OSError:
        return False
    return True


def running(runs: Path) -> list[Path]:
    """The runs in a folder whose scan is running, oldest first."""
    newest = ((run, parts_of(run)[-1]) for run in runs.glob("*/"))
    return sorted(run for run, part in newest if (part / CONTROL).is_dir() and held(part / SCAN))


def tell(run: Path, verb: Verb) -> State:
    """Tell a running scan, and wait until it has done it, or for 20 s; the state that it is in then.

    Raises:
        ConfigError: no scan runs there, or none that answers within 5 s; the request is withdrawn.
        DataError: the request cannot be made.
    """
    part = parts_of(run)[-1]
    request = part / CONTROL / verb
    if not request.parent.is_dir():
        raise ConfigError(f"no scan runs in {run}. Nothing was changed.")
    try:
        request.touch(mode=0o600)
    except OSError as error:
        raise DataError(
            f"{run} cannot be told to {verb}: {error.strerror}. Ctrl-C at its terminal stops a scan."
        ) from error
    if not _within(_ANSWER, lambda: not request.exists()) and _taken(request):
        raise ConfigError(
            f"the scan in {run} does not answer: it has died, or its disk hangs. Nothing was changed. If it has died, "
            "look at the instrument, and run `beamline recover` on its file."
        )
    _within(_EFFECT, lambda: _done(state_of(part), verb))
    return state_of(part)


def state_of(run: Path) -> State:
    """The state of the scan in this folder, by the last line on it in its log of events."""
    state = State.IDLE
    with suppress(OSError), (run / EVENTS).open(encoding="utf-8") as lines:
        for line in lines:
            with suppress(ValueError):  # a line that is just being written
                if line.startswith('{"event": "state"') and "source" not in (said := json.loads(line)):
                    state = State(said["state"])  # without those of the live reconstruction
    return state


def _done(state: State, verb: Verb) -> bool:
    """Whether a scan in this state has done what it was told."""
    if state is State.FINISHING or state.ended:
        return True
    if verb in (Verb.PAUSE, Verb.RESUME):
        return (state is State.PAUSED) is (verb is Verb.PAUSE)
    return False


def _within(seconds: float, met: Callable[[], bool]) -> bool:
    deadline = time.monotonic() + seconds
    while not (now := met()) and time.monotonic() < deadline:
        time.sleep(_POLL)
    return now
