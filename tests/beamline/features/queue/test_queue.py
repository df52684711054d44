"""A queue of scans: which scans start, that none starts twice, and the summary at the end."""

from __future__ import annotations

from pathlib import Path

import pytest

from beamline.config.load import Config, config_folder, load
from beamline.core.errors import AlarmError, DataError, ScanStopped
from beamline.core.events import RunStarted, StateEntered
from beamline.core.stop import StopRequest
from beamline.features.queue.scans import (
    QueueError,
    QueueStatus,
    RunNotes,
    Taken,
    raise_unless_complete,
    run_queue,
    summary,
)
from beamline.scan.moves import UNSAFE

SIMULATED = config_folder() / "simulated.yaml"


@pytest.fixture(scope="module")
def queue() -> tuple[Config, ...]:
    return tuple(load(SIMULATED, [f"sample.name={name}"]) for name in ("one", "two", "three"))


def test_a_failure_does_not_keep_the_next_from_its_turn(queue: tuple[Config, ...], tmp_path: Path) -> None:
    def take(n: int, waiting: Config, stop: StopRequest, run: RunNotes) -> Taken:
        run(RunStarted(tmp_path / waiting.sample.name, tmp_path, waiting.sample.name, 1, 1.0, 1, ()))
        if n == 1:
            stop.stop("the monitor asked", by_itself=True)
            raise DataError("frames are missing")
        return tmp_path / f"{n}.h5", ("2 frames have an alarm.",) * (n == 2)

    outcomes = run_queue(queue, take)
    assert [outcome.status for outcome in outcomes] == [QueueStatus.COMPLETE, QueueStatus.FAILED, QueueStatus.ALARMS]
    assert "frames are missing" in summary(outcomes)[1] and outcomes[1].path == tmp_path / "two"
    with pytest.raises(QueueError, match="2 of 3") as raised:
        raise_unless_complete(outcomes)
    assert raised.value.exit_code == DataError.exit_code
    with pytest.raises(AlarmError, match="three"):
        raise_unless_complete((outcomes[0], outcomes[2]))
    raise_unless_complete(outcomes[:1])
    strict = run_queue(queue, take, stop_on_failure=True)
    assert [outcome.status for outcome in strict] == [QueueStatus.COMPLETE, QueueStatus.FAILED, QueueStatus.NOT_STARTED]


@pytest.mark.parametrize("how", ["stop", "interrupt", "stop while a volume is made", "unsafe"])
def test_nothing_begins_after_a_stop_or_with_an_instrument_that_did_not_obey(
    queue: tuple[Config, ...], how: str
) -> None:
    begun = []

    def take(n: int, waiting: Config, stop: StopRequest, run: RunNotes) -> Taken:
        begun.append(waiting.sample.name)
        if how == "interrupt":
            raise KeyboardInterrupt
        if how == "unsafe":
            run(StateEntered("finishing", UNSAFE))
            raise DataError("the stage is silent")
        stop.stop()
        if how == "stop":
            raise ScanStopped("Stopped after 3 of 9 projections")
        return Path("s.h5"), ()

    outcomes = run_queue(queue, take)
    assert begun == ["one"] and {outcome.status for outcome in outcomes[1:]} == {QueueStatus.NOT_STARTED}
    first = {"stop while a volume is made": QueueStatus.COMPLETE, "unsafe": QueueStatus.FAILED}.get(
        how, QueueStatus.STOPPED
    )
    assert outcomes[0].status is first
    with pytest.raises(QueueError) as raised:
        raise_unless_complete(outcomes)
    assert raised.value.exit_code == {"stop": 4, "interrupt": 130, "unsafe": 5}.get(how, 4)
