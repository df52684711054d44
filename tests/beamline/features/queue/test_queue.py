"""A queue of scans: what is read from a table, which scans start, and the summary at the end."""

from __future__ import annotations

from pathlib import Path

import pytest

from beamline.config.load import Config, config_folder
from beamline.core.errors import AlarmError, ConfigError, DataError, ScanStopped
from beamline.core.events import RunStarted, StateEntered
from beamline.core.stop import StopRequest
from beamline.features.queue.scans import (
    QueueError,
    QueueStatus,
    RunNotes,
    Taken,
    load_queue,
    queue_needs,
    raise_unless_complete,
    run_queue,
    summary,
)
from beamline.scan.moves import UNSAFE

SIMULATED = config_folder() / "simulated.yaml"


@pytest.fixture(scope="module")
def queue() -> tuple[Config, ...]:
    return tuple(load_queue([SIMULATED], [f"sample.name={name}"])[0] for name in ("one", "two", "three"))


def table(folder: Path, *lines: str) -> Path:
    path = folder / "day.csv"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def test_a_table_has_a_scan_a_line_and_empty_cells_change_nothing(tmp_path: Path) -> None:
    (tmp_path / "own.yaml").write_text(SIMULATED.read_text("utf-8"), encoding="utf-8")
    lines = "config, sample.name,scan.exposure_s", "own.yaml,a,", "", f"{SIMULATED},b,0.02"
    scans = load_queue([table(tmp_path, *lines), SIMULATED], ["scan.angles.views=60"])
    named = [(config.sample.name, config.scan.exposure_s) for config in scans]
    assert named == [
        ("a", 0.05),
        ("b", 0.02),
        ("battery", 0.05),
    ]
    assert {config.scan.angles.views for config in scans} == {60}  # type: ignore[union-attr]
    needs = queue_needs(scans, tmp_path)
    worked = [each.timeline for _, each in needs.scans]
    assert needs.duration == pytest.approx(sum(each.duration for each in worked))
    assert needs.total_bytes == sum(each.total_bytes for each in worked) and len(needs.data()["scans"]) == 3
    assert "3 scans" in needs.lines()[-1]
    with pytest.raises(ConfigError, match=r"a: .*\n.*b: "):
        queue_needs(load_queue([tmp_path / "day.csv"], ["scan.period_s=0.001"]), tmp_path).refuse_impossible()


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (("sample.name", "a"), "is not a table of scans"),
        (("config,x",), "is not a table of scans"),
        (("config,config", "a.yaml,b.yaml"), "is not a table of scans"),
        (("config,sample.name", ",a"), "line 2: ',a' has 2 cells; expected 2, with a file"),
        (("config,sample.name", "a.yaml,b,c"), "line 2: 'a.yaml,b,c' has 3 cells"),
        (("config", "none.yaml", "gone.yaml"), r"line 2: .*none.yaml(.|\n)*line 3: .*gone.yaml"),
        (("config,scan.modd", f"{SIMULATED},1"), "line 2: .*did you mean mode"),
    ],
)
def test_a_wrong_table_is_refused_with_its_lines(tmp_path: Path, lines: tuple[str, ...], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_queue([table(tmp_path, *lines)], ())


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
