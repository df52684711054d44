"""States of a scan and their allowed order; docs/states.md draws them and explains the verbs in each."""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from beamline.core.events import Sink, StateEntered


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
