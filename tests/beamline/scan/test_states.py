"""The table of states is complete, and docs/states.md shows it."""

import re
from pathlib import Path

import pytest

from beamline.scan.control import NEXT, State, StateMachine

PAGE = Path(__file__).parents[3] / "docs" / "states.md"
ENDS = {State.DONE, State.STOPPED, State.ABORTED, State.FAILED}


def test_every_state_is_reached_from_idle_and_leads_to_an_end() -> None:
    reached, new = {State.IDLE}, {State.IDLE}
    while new := {after for state in new for after in NEXT[state]} - reached:
        reached |= new
    assert reached == set(State) == set(NEXT)
    assert {state for state in State if state.ended} == ENDS
    assert all(State.FAILED in NEXT[state] for state in State if state not in ENDS | {State.IDLE})


def test_the_page_has_the_table() -> None:
    blocks = PAGE.read_text(encoding="utf-8").split("\n\n")
    (table,) = (block.splitlines()[2:] for block in blocks if block.startswith("| state | next state |"))
    rows = [[re.findall(r"`(\w+)`|\*(taking)\*", cell) for cell in line.split("|")[1:3]] for line in table]
    taking = {State(name) for name, _ in rows[2][0] if name}

    def states(cell: list[tuple[str, str]]) -> set[State]:
        return {state for name, group in cell for state in (taking if group else {State(name)})}

    drawn = {(one, other) for row in rows for one in states(row[0]) for other in states(row[1]) if one is not other}
    assert drawn == {(before, after) for before in State for after in NEXT[before]}


def test_what_the_table_does_not_have_is_refused_and_to_stay_is_silent() -> None:
    told = []
    machine = StateMachine(lambda event: told.append((event.event, event.data["state"], event.data["message"])))
    with pytest.raises(ValueError, match="idle to paused"):
        machine.enter(State.PAUSED)
    machine.enter(State.PREPARING)
    machine.enter(State.PREPARING)
    machine.enter(State.PREPARING, "still")
    assert told == [("state", "preparing", ""), ("state", "preparing", "still")]
    assert machine.state is State.PREPARING
