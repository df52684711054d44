"""Control: the states of a scan and their allowed order, and commands to a running scan from another terminal.

docs/states.md has a diagram of the states and explains the commands in each state. A command is an empty file with the
name of the command, in the folder `control` of the run. Only the owner of the run can enter this folder. The scan
removes the file and carries out the command. This works on every operating system and file system, without an open port
or a parser.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

from beamline.core.errors import ConfigError, DataError
from beamline.core.events import Sink, StateEntered
from beamline.core.files import CONTROL, parts_of
from beamline.core.stop import PauseRequest, StopRequest
from beamline.plan.passes import Choice
from beamline.storage.run_record import DIED, alive, is_series_folder, read_record


class State(StrEnum):
    """The activity of a scan."""

    IDLE = "idle"
    PREPARING = "preparing"
    DARKS = "darks"
    FLATS = "flats"
    TAXI = "taxi"
    ACQUIRING = "acquiring"
    ASKING = "asking"
    PAUSED = "paused"
    FINISHING = "finishing"
    DONE = "done"
    STOPPED = "stopped"
    ABORTED = "aborted"
    FAILED = "failed"

    @property
    def ended(self) -> bool:
        """True if this state is final."""
        return not NEXT[self]


_TAKING = frozenset({State.DARKS, State.FLATS, State.TAXI, State.ACQUIRING})

NEXT: Mapping[State, frozenset[State]] = {
    State.IDLE: frozenset({State.PREPARING}),
    State.PREPARING: _TAKING | {State.PAUSED, State.FINISHING, State.ABORTED, State.FAILED},
    **{state: (_TAKING - {state}) | {State.ASKING, State.PAUSED, State.FINISHING, State.FAILED} for state in _TAKING},
    State.ASKING: _TAKING | {State.PAUSED, State.FINISHING, State.FAILED},
    State.PAUSED: _TAKING | {State.FINISHING, State.FAILED},
    State.FINISHING: frozenset({State.DONE, State.STOPPED, State.ABORTED, State.FAILED}),
    **dict.fromkeys((State.DONE, State.STOPPED, State.ABORTED, State.FAILED), frozenset[State]()),
}
"""The states that may follow each state."""


class StateMachine:
    """The state machine of one scan; `state` is the current state. Changes are sent to the sink as the event
    `state`."""

    def __init__(self, sink: Sink = lambda event: None, state: State = State.IDLE) -> None:
        self._sink, self.state = sink, state

    def enter(self, state: State, message: str = "") -> None:
        """Change to a state, with a message. If the state stays the same and there is no message, no event is sent.

        Raises:
            ValueError: the state must not follow the present one. Nothing has changed.
        """
        if state is not self.state and state not in NEXT[self.state]:
            raise ValueError(f"a scan cannot go from {self.state} to {state}")
        if state is not self.state or message:
            self.state = state
            self._sink(StateEntered(state, message))


POLL = 0.1  # real s between checks
ANSWER_WITHIN = 5.0  # real time in s within which a scan accepts a command
EFFECT_WITHIN = 20.0  # real time in s within which most commands are done: the stage has braked, the frame is exposed


class Verb(StrEnum):
    """Commands to a running scan, most urgent first."""

    ABORT = "abort"
    STOP = "stop"
    PAUSE = "pause"
    RESUME = "resume"


@contextmanager
def commands_taken(
    folder: Path, stop: StopRequest, pause: PauseRequest, choose: Callable[[Choice], None] = lambda choice: None
) -> Iterator[None]:
    """A context in which the scan of this folder carries out commands. They are files in a folder that only the owner
    can enter.

    Args:
        choose: function that receives the operator's choice of what is measured next.

    Raises:
        DataError: the folder for the commands cannot be created.
    """
    commands_folder, ended = folder / CONTROL, threading.Event()
    actions: Mapping[Verb | Choice, Callable[[], None]] = {
        Verb.ABORT: stop.abort, Verb.STOP: stop.stop, Verb.PAUSE: pause.pause, Verb.RESUME: pause.resume,
        **{choice: partial(choose, choice) for choice in Choice},
    }  # fmt: skip

    def take_verbs() -> None:
        while not ended.wait(POLL):
            for command, action in actions.items():
                if _remove_request(commands_folder / command):
                    action()

    try:
        commands_folder.mkdir(mode=0o700)
    except OSError as error:
        raise DataError(
            f"{commands_folder} cannot be created ({error.strerror}). Nothing has moved, and no frame was recorded."
        ) from error
    thread = threading.Thread(target=take_verbs, name="control", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(ANSWER_WITHIN)
        for command in actions:
            _remove_request(commands_folder / command)
        with suppress(OSError):
            commands_folder.rmdir()


def _remove_request(request: Path) -> bool:
    """Remove a request; False if there is none."""
    try:
        request.unlink()
    except OSError:
        return False
    return True


def running(runs: Path) -> list[Path]:
    """The runs in a folder, also those of a series, whose scan is in progress, oldest first."""
    runs_in_series = [place for folder in series_in(runs) for place in folder.glob("*/")]
    return sorted(run for run in (*runs.glob("*/"), *runs_in_series) if alive(parts_of(run)[-1]))


def series_in(folder: Path) -> list[Path]:
    """The folders of series of scans in a folder."""
    return [path for path in folder.glob("*/") if is_series_folder(path)]


@dataclass(frozen=True)
class SentCommand:
    """A command sent to the scan of a part of a run, with its time on the monotonic clock."""

    part: Path
    command: Verb | Choice
    since: float

    def state(self) -> State | None:
        """The state of the scan if the command is carried out, or if 20 s have passed; otherwise None. The function
        returns at once.

        Raises:
            ConfigError: the scan has not answered for 5 s. The request is withdrawn.
        """
        request, seconds = self.part / CONTROL / self.command, time.monotonic() - self.since
        if request.exists():
            if seconds < ANSWER_WITHIN:
                return None
            if _remove_request(request):
                raise ConfigError(
                    f"the scan in {self.part} does not answer: either its process was killed, or its disk hangs. "
                    "Nothing was changed. If the process was killed, check the instrument, and run `beamline "
                    "recover` on the scan file."
                )
        state = state_of(self.part)
        return state if _is_carried_out(state, self.command) or seconds > EFFECT_WITHIN else None


def ask(run: Path, verb: Verb | Choice) -> SentCommand:
    """Send a command to a running scan without waiting, so that the next command can follow at once.

    Args:
        verb: the command; or a choice of what is measured next, which the scan accepts only while it waits for a
            decision.

    Raises:
        ConfigError: no scan runs there, or the scan is not waiting for a decision.
        DataError: the request cannot be made.
    """
    part = parts_of(run)[-1]
    request = part / CONTROL / verb
    if not request.parent.is_dir():
        raise ConfigError(f"no scan is running in {run}. Nothing was changed.")
    if isinstance(verb, Choice) and (state := state_of(part)) is not State.ASKING:
        raise ConfigError(
            f"the scan in {run} is not waiting for a decision on what to measure next: it is {state}. With "
            "`scan.decide: ask`, a scan waits after each pass of projections. Nothing was changed."
        )
    try:
        request.touch()
    except OSError as error:
        raise DataError(
            f"{run} does not accept {verb}: {error.strerror}. Only the user who started a scan can control the scan; "
            "Ctrl-C at its terminal stops the scan."
        ) from error
    return SentCommand(part, verb, time.monotonic())


def tell(run: Path, verb: Verb | Choice) -> State:
    """Send a command to a running scan, and wait until it is done. Returns the state. Raises the errors of `ask` and
    `SentCommand`.
    """
    sent = ask(run, verb)
    while (state := sent.state()) is None:
        time.sleep(POLL)
    return state


def state_of(part: Path) -> State:
    """The state of the scan in this folder, from its record; `failed` if its process was killed."""
    record, states = read_record(part), {DIED: State.FAILED, **{state.value: state for state in State}}
    return State.IDLE if record is None else states.get(record.state, State.IDLE)


def _is_carried_out(state: State, verb: Verb | Choice) -> bool:
    """True if a scan in this state has carried out the command."""
    if state is State.FINISHING or state.ended:
        return True
    if verb in (Verb.PAUSE, Verb.RESUME):
        return (state is State.PAUSED) is (verb is Verb.PAUSE)
    return isinstance(verb, Choice) and state is not State.ASKING
