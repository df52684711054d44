"""Control: states of a scan in their allowed order, and verbs to a running one from another terminal.

docs/states.md draws the states and explains the verbs in each. A verb is an empty file of that name in the folder
`control` of the run, which only its owner can write to. The scan removes the file and obeys. This works on every system
and file system, without an open port or a parser. Owners and modes, if the system has them, are checked at every use,
and a replaced folder is ignored.
"""

from __future__ import annotations

import os
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Sink, StateEntered, Warned
from beamline.core.files import CONTROL, parts_of
from beamline.core.stop import PauseRequest, StopRequest
from beamline.storage.run_record import DIED, alive, read_record


class State(StrEnum):
    """The activity of a scan."""

    IDLE = "idle"
    PREPARING = "preparing"
    DARKS = "darks"
    FLATS = "flats"
    TAXI = "taxi"
    ACQUIRING = "acquiring"
    PAUSED = "paused"
    FINISHING = "finishing"
    DONE = "done"
    STOPPED = "stopped"
    ABORTED = "aborted"
    FAILED = "failed"

    @property
    def ended(self) -> bool:
        """Whether this state is final."""
        return not NEXT[self]


_TAKING = frozenset({State.DARKS, State.FLATS, State.TAXI, State.ACQUIRING})

NEXT: Mapping[State, frozenset[State]] = {
    State.IDLE: frozenset({State.PREPARING}),
    State.PREPARING: _TAKING | {State.FINISHING, State.ABORTED, State.FAILED},
    **{state: (_TAKING - {state}) | {State.PAUSED, State.FINISHING, State.FAILED} for state in _TAKING},
    State.PAUSED: _TAKING | {State.FINISHING, State.FAILED},
    State.FINISHING: frozenset({State.DONE, State.STOPPED, State.ABORTED, State.FAILED}),
    **dict.fromkeys((State.DONE, State.STOPPED, State.ABORTED, State.FAILED), frozenset[State]()),
}
"""The states that may follow each one."""


class StateMachine:
    """The state machine of one scan; `state` is the current state. Changes are sent to the sink as the event
    `state`."""

    def __init__(self, sink: Sink = lambda event: None, state: State = State.IDLE) -> None:
        self._sink, self.state = sink, state

    def enter(self, state: State, message: str = "") -> None:
        """Change to a state, with a message; staying in a state without a message emits nothing.

        Raises:
            ValueError: the state must not follow the present one; nothing has changed.
        """
        if state is not self.state and state not in NEXT[self.state]:
            raise ValueError(f"a scan cannot go from {self.state} to {state}")
        if state is not self.state or message:
            self.state = state
            self._sink(StateEntered(state, message))


POLL = 0.1  # real s between checks
ANSWER_WITHIN = 5.0  # real s within which a scan accepts a verb
EFFECT_WITHIN = 20.0  # real s within which most verbs have been done: a stage has braked, a frame is exposed


class Verb(StrEnum):
    """Commands to a running scan, most urgent first."""

    ABORT = "abort"
    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"


class _Requests:
    """The folder of requests, made here and held open, so that a replacement is noticed. OSError: it cannot be made."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(mode=0o700)
        self._folder, self._held = folder, -1
        if sys.platform != "win32":
            self._held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            os.fchmod(self._held, 0o700)

    def fault(self) -> str:
        """Reason for which no request can be trusted, or can arrive; "" if all is well."""
        if self._held < 0:
            return ""
        try:
            ours = os.fstat(self._held)
            same = os.path.samestat(os.lstat(self._folder), ours)
        except OSError:
            same = False
        return _not_private(ours) if same else "it is gone, or another was put in its place"

    def taken(self, verb: Verb) -> bool:
        """Remove a request; False if there is none by its owner or root."""
        if self._held < 0:
            return _taken(self._folder / verb)
        try:
            made = os.stat(verb, dir_fd=self._held, follow_symlinks=False)
            os.unlink(verb, dir_fd=self._held)
        except OSError:
            return False
        return stat.S_ISREG(made.st_mode) and made.st_uid in (_user(), 0)

    def close(self) -> None:
        """Remove the remaining requests, and the folder."""
        for verb in Verb:
            self.taken(verb)
        if self._held >= 0:
            os.close(self._held)
        with suppress(OSError):
            self._folder.rmdir()


def _user() -> int:
    """The number of the user whose rights this process has; 0 on Windows, whose files name none."""
    if sys.platform == "win32":
        return 0
    return os.geteuid()


def _not_private(folder: os.stat_result) -> str:
    """Why somebody else may have made requests there; "" if only we can."""
    if not stat.S_ISDIR(folder.st_mode):
        return "it is no folder of its own"
    if _user() not in (folder.st_uid, 0):
        return f"it belongs to the user {folder.st_uid}"
    if folder.st_mode & 0o022:
        return f"others may write to it (mode {stat.S_IMODE(folder.st_mode):03o})"
    return ""


@contextmanager
def verbs_taken(
    folder: Path, stop: StopRequest, pause: PauseRequest, sink: Sink = lambda event: None
) -> Iterator[None]:
    """A context in which the scan of this folder obeys commands; warns if that is impossible.

    Raises:
        DataError: the disk does not take the folder for them.
    """
    place, over = folder / CONTROL, threading.Event()
    actions: Mapping[Verb, Callable[[], None]] = {
        Verb.ABORT: stop.abort, Verb.STOP: stop.stop, Verb.PAUSE: pause.pause, Verb.RESUME: pause.resume,
    }  # fmt: skip

    def take_verbs() -> None:
        told = False
        while not over.wait(POLL):
            if fault := requests.fault():
                if not told:
                    message = f"No verb from another terminal is done: {place}: {fault}. Ctrl-C here stops the scan."
                    sink(Warned(message))
                told = True
                continue
            for verb, action in actions.items():
                if requests.taken(verb):
                    action()

    try:
        requests = _Requests(place)
    except OSError as error:
        raise DataError(
            f"{place} cannot be created ({error.strerror}). Nothing has moved, and no frame was recorded."
        ) from error
    thread = threading.Thread(target=take_verbs, name="control", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join(ANSWER_WITHIN)
        requests.close()


def _taken(request: Path) -> bool:
    """Remove a request; False if there is none."""
    try:
        request.unlink()
    except OSError:
        return False
    return True


def running(runs: Path) -> list[Path]:
    """The runs in a folder whose scan is in progress, oldest first."""
    return sorted(run for run in runs.glob("*/") if alive(parts_of(run)[-1]))


@dataclass(frozen=True)
class Asked:
    """A command sent to the scan of a part of a run, with its time on the monotonic clock."""

    part: Path
    verb: Verb
    since: float

    def state(self) -> State | None:
        """The scan's state once the command is done, or after 20 s; None before that. Returns at once.

        Raises:
            ConfigError: the scan has not answered for 5 s; the request is withdrawn.
        """
        request, seconds = self.part / CONTROL / self.verb, time.monotonic() - self.since
        if request.exists():
            if seconds < ANSWER_WITHIN:
                return None
            if _taken(request):
                raise ConfigError(
                    f"the scan in {self.part} does not answer: it has died, or its disk hangs. Nothing was changed. If "
                    "it has died, look at the instrument, and run `beamline recover` on its file."
                )
        state = state_of(self.part)
        return state if _done(state, self.verb) or seconds > EFFECT_WITHIN else None


def ask(run: Path, verb: Verb) -> Asked:
    """Send a command to a running scan without waiting, so that the next command can follow at once.

    Raises:
        ConfigError: no scan runs there, or somebody else's.
        DataError: the request cannot be made.
    """
    part = parts_of(run)[-1]
    request = part / CONTROL / verb
    try:
        folder = os.lstat(request.parent)
    except OSError:
        raise ConfigError(f"no scan is running in {run}. Nothing was changed.") from None
    if sys.platform != "win32" and (fault := _not_private(folder)):
        raise ConfigError(
            f"{request.parent}: {fault}. Only the user who started a scan can control it. Nothing was changed."
        )
    try:
        with suppress(FileExistsError):
            os.close(os.open(request, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
    except OSError as error:
        raise DataError(
            f"{run} does not accept {verb}: {error.strerror}. Ctrl-C at its terminal stops a scan."
        ) from error
    return Asked(part, verb, time.monotonic())


def tell(run: Path, verb: Verb) -> State:
    """Send a command to a running scan, and wait until it is done; returns the state. Raises as `ask` and `Asked`."""
    asked = ask(run, verb)
    while (state := asked.state()) is None:
        time.sleep(POLL)
    return state


def state_of(part: Path) -> State:
    """The state of the scan in this folder, by its record; `failed` where its process has died."""
    record, states = read_record(part), {DIED: State.FAILED, **{state.value: state for state in State}}
    return State.IDLE if record is None else states.get(record.state, State.IDLE)


def _done(state: State, verb: Verb) -> bool:
    """Whether a scan in this state has obeyed the verb."""
    if state is State.FINISHING or state.ended:
        return True
    if verb in (Verb.PAUSE, Verb.RESUME):
        return (state is State.PAUSED) is (verb is Verb.PAUSE)
    return False
