"""Scans that decide: an error model or the operator chooses what to measure; the file records the reason."""

import json
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.config.load import Config
from beamline.core.errors import ScanStopped
from beamline.core.events import Event
from beamline.core.stop import StopRequest
from beamline.instrument.connect import ConnectedDevices
from beamline.plan.passes import Choice
from beamline.reconstruct.scan_facts import facts_of
from beamline.scan import preflight
from beamline.scan.control import State, Verb, ask, state_of
from beamline.scan.live_process import LiveCommand
from beamline.scan.preflight import scan_info
from beamline.scan.resume import NothingMissing, open_for_resume
from beamline.scan.run import run_scan
from beamline.scan.runs import cells, describe
from beamline.storage.readers.open import open_scan
from beamline.storage.rules.evidence import ScanEvidence
from beamline.storage.rules.scan import scan_ended
from beamline.storage.writers import layout
from beamline.storage.writers.nxtomo import ScanInfo
from tests.beamline.fakes import FakeInstrument
from tests.beamline.ran import Ran
from tests.clock import wait_until
from tests.slow_cases import others_slow

PASSES = (
    "scan.angles={scheme: interlaced, views: 12, passes: 4}",
    "scan.period_s=2",
    "recon.live=true",
    "scan.decide=do",
)
LIVE = """
import json, pathlib, sys, time
laws = json.loads(sys.argv[3])
events = pathlib.Path(sys.argv[1]).with_name("events.jsonl")
for n, law in enumerate(laws, start=1):
    while sum('"block_done"' in line and '"projection"' in line for line in events.read_text().splitlines()) < n:
        if '"scan_done"' in events.read_text():
            sys.exit(1)
        time.sleep(0.02)
    known = {"event": "error_law", "number": n, "n_views": 3 * n, "noise": 0.1, "offset": 0.0}
    print(json.dumps({**known, **law}), flush=True)
while '"scan_done"' not in events.read_text():
    time.sleep(0.02)
print(json.dumps({"event": "done", "output": sys.argv[2]}), flush=True)
"""


def live(*laws: tuple[float, float, float | None]) -> Callable[[Path, Path], Sequence[str]]:
    """A live reconstruction that measures these laws after the passes: exponent, its error, and dB gained."""
    values = [{"exponent": exponent, "exponent_error": error, "gained": gained} for exponent, error, gained in laws]
    ready = """print('{"event": "state", "state": "ready", "message": ""}', flush=True)\n"""
    return lambda scan, output: [sys.executable, "-c", ready + LIVE, str(scan), str(output), json.dumps(values)]


def written(ran: Ran) -> tuple[list[int], list[dict[str, Any]]]:
    """The ends of passes in the file of a run, and its decisions."""
    with h5py.File(ran.folder / "scan.h5") as file:
        return file[layout.PASS_ENDS][()].tolist(), [json.loads(line) for line in file[layout.DECISIONS].asstr()[()]]


def test_a_scan_ends_when_its_views_are_enough_and_says_why(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(), *PASSES, live=live((1.0, 0.5, None), (1.0, 0.5, 2.5), (0.5, 0.0, 1.0)))
    assert ran.error is None and ran.states[-1] == "done" and ran.result.clean
    ends, decisions = written(ran)
    assert ends == [8, 11, 14]  # after 3 darks and 2 flats
    chosen = [(decision["choice"], decision["by"]) for decision in decisions]
    assert chosen == [("next", "program")] * 2 + [("enough", "program")]
    assert (decisions[1]["predicted"], decisions[1]["gained"]) == (decisions[0]["options"][0]["gain"], 2.5)
    assert [event.data | {"time": 0} for event in ran.of("next_chosen")] == [
        {name: value for name, value in decision.items() if value is not None} | {"time": 0} for decision in decisions
    ]
    assert [event.data["number"] for event in ran.of("pass_ended")] == [1, 2, 3]
    ran.assert_good_file(16, "complete")  # with the flats of the end
    assert [(each["passes"], each.get("dropped", 0)) for each in decisions] == [(1, 0), (2, 0), (3, 3)]
    assert ran.of("frame")[-1].data["n"] == ran.of("frame")[-1].data["of"] == 16
    run, said = (
        describe(ran.folder),
        "The scan ended after pass 3, because `enough` was chosen by the program: the remaining projections of ",
    )
    assert (run.frames, run.planned, run.state) == (16, 19, "done") and run.ended.startswith(said)
    assert "16 of 19" in cells(run)
    with open_scan(ran.folder / "scan.h5") as source:
        assert [(found.severity, found.message) for found in scan_ended(ScanEvidence(source))] == [("info", run.ended)]
        facts = facts_of(source)
        assert facts.frames == "16/19" and run.ended in facts.remarks and source.attributes["ended"] == run.ended
    assert run.ended.endswith("the target accepts a loss of 1 dB. 3 planned frames were not taken.")
    assert len(ran.of("recon_done")) == 1  # its volume is waited for


def test_what_is_better_than_the_next_pass_is_measured_in_place_of_the_last_one(tmp_path: Path) -> None:
    noisy = live((0.1, 0.0, None), (0.1, 0.0, None), (0.1, 0.0, None))
    ran = Ran(
        tmp_path, FakeInstrument(), *PASSES, "scan.target={dose: 1}",
        live=lambda scan, output: [word.replace('"noise": 0.1', '"noise": 0.8') for word in noisy(scan, output)],
    )  # fmt: skip
    assert ran.error is None
    ends, decisions = written(ran)
    assert ends == [8, 11, 14, 17] and [decision["choice"] for decision in decisions] == ["again"] * 3
    assert ran.result.n_frames == 19


def gone(scan: Path, output: Path) -> Sequence[str]:
    return [sys.executable, "-c", "raise SystemExit(1)"]


@pytest.mark.parametrize(
    ("command", "cone", "why"),
    others_slow(
        [
            (gone, False, "no live reconstruction is running"),
            (None, False, "no live reconstruction is running"),
            (live((1.0, 0.1, None)), True, "improvements are not predicted for a cone beam"),
        ]
    ),
)
def test_where_nothing_can_be_predicted_the_plan_stays_as_it_is_and_one_sentence_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: LiveCommand | None, cone: bool, why: str
) -> None:
    def info(config: Config, instrument: ConnectedDevices) -> ScanInfo:
        return replace(scan_info(config, instrument), source_distance_mm=10.0 if cone else None)

    monkeypatch.setattr(preflight, "scan_info", info)
    ran = Ran(tmp_path, FakeInstrument(), *PASSES, "scan.target={seconds: 1}", live=command)
    assert ran.error is None
    ran.assert_good_file(19, "complete")
    ends, (only,) = written(ran)
    assert ends == [8, 11, 14, 17] and (only["by"], only["choice"], only["reason"]) == ("plan", "next", why)
    assert len(ran.of("next_chosen")) == 1


def test_without_decisions_nothing_is_predicted_or_written(tmp_path: Path) -> None:
    ran = Ran(tmp_path, FakeInstrument(), *PASSES[:2])
    ran.assert_good_file(19, "complete")
    assert not ran.of("pass_ended")
    with h5py.File(ran.folder / "scan.h5") as file:
        assert layout.PASS_ENDS not in file and layout.DECISIONS not in file


def test_the_operator_is_asked_with_a_closed_shutter_and_answers_from_another_terminal(tmp_path: Path) -> None:
    instrument, answers, seen = FakeInstrument(), [Choice.AGAIN, Choice.ENOUGH], list[tuple[str, bool]]()

    def answer(event: Event) -> None:
        if event.event == "state" and event.data["state"] == State.ASKING:
            (run,) = tmp_path.iterdir()
            seen.append((event.data["state"], instrument.is_open))
            wait_until(lambda: state_of(run) is State.ASKING)
            ask(run, answers.pop(0))

    ran = Ran(
        tmp_path, instrument, *PASSES, "scan.decide=ask", "scan.wait_s=10",
        live=live((1.0, 0.1, None), (1.0, 0.1, None)), heard=answer,
    )  # fmt: skip
    assert ran.error is None
    assert seen == [("asking", False)] * 2
    assert [event.data["by"] for event in ran.of("next_chosen")] == ["operator"] * 2
    ran.assert_good_file(13, "complete")
    ran.assert_safe()


def test_a_scan_that_asks_is_paused_and_asks_again(tmp_path: Path) -> None:
    instrument, seen = FakeInstrument(), list[tuple[str, bool]]()

    def react(event: Event) -> None:
        state = event.data.get("state")
        if event.data.get("message") == "The scan continues":
            seen.append(("goes on", instrument.is_open))
        if event.event != "state" or state not in (State.ASKING, State.PAUSED):
            return
        (run,) = tmp_path.iterdir()
        wait_until(lambda: state_of(run) is state)
        seen.append((state, instrument.is_open))
        ask(run, Verb.RESUME if state is State.PAUSED else Verb.PAUSE if len(seen) == 1 else Choice.ENOUGH)

    asks = ("scan.decide=ask", "scan.wait_s=300", "scan.mode=step", "scan.pass_views=5")
    ran = Ran(tmp_path, instrument, *PASSES[1:], *asks, live=live((1.0, 0.1, None)), heard=react)
    assert ran.error is None
    assert seen == [("asking", False), ("paused", False), ("goes on", False), ("asking", False)]
    said = [event.data.get("message") for event in ran.of("state") if event.data["state"] == State.ASKING]
    assert said == ["", "The scan again waits for a decision on what to measure next"]
    assert written(ran)[0] == [10] and len(ran.of("pass_ended")) == len(ran.of("next_chosen")) == 1
    ran.assert_good_file(12, "complete")


@pytest.mark.parametrize("verb", others_slow(["stop", "abort"]))
def test_a_stop_or_an_abort_ends_the_question(tmp_path: Path, verb: str) -> None:
    stop = StopRequest()

    def end(event: Event) -> None:
        if event.event == "state" and event.data["state"] == State.ASKING:
            threading.Timer(0.1, getattr(stop, verb)).start()

    ran = Ran(
        tmp_path, FakeInstrument(), *PASSES, "scan.decide=ask", "scan.wait_s=300", live=live((1.0, 0.1, None)),
        heard=end, stop=stop,
    )  # fmt: skip
    assert isinstance(ran.error, ScanStopped) and not ran.of("next_chosen")
    assert ran.states[-1] == ("stopped" if verb == "stop" else "aborted")
    ran.assert_safe()


def test_a_resumed_run_goes_on_deciding_and_its_wish_counts_what_earlier_parts_took(tmp_path: Path) -> None:
    laws = live((1.0, 0.1, None), (1.0, 0.1, None), (1.0, 0.1, None))
    stop, words = StopRequest(), (*PASSES, "scan.target={seconds: 28}")
    ran = Ran(tmp_path, FakeInstrument(at={12: stop.stop}), *words, live=laws, stop=stop)  # in the third pass
    assert isinstance(ran.error, ScanStopped) and len(written(ran)[1]) == 2
    instrument, events = FakeInstrument(), list[Event]()
    instrument.clock.sleep(1000.0)  # which does not count
    with open_for_resume(ran.folder) as series:
        with h5py.File(ran.folder / "scan.h5") as file:
            assert series.seconds == pytest.approx(np.ptp(file[layout.TIME][()]))
        last = live((1.0, 0.1, None))

        def words_of(scan: Path, output: Path) -> list[str]:
            return [word.replace('"number": n', '"number": 3') for word in last(scan, output)]

        run_scan(series.config, series, [events.append], instrument=instrument.connected(), live=words_of)
    (chosen,) = [event.data for event in events if event.event == "next_chosen"]
    assert (chosen["number"], chosen["n_views"], chosen["choice"]) == (3, 9, "enough")
    assert "next would end the scan after" in chosen["reason"]


def test_a_choice_that_was_due_is_asked_for_before_any_frame_and_enough_takes_what_follows_the_passes(
    tmp_path: Path,
) -> None:
    """Of a scan without references at its start, which is paused when it asks for the second time."""
    stop, events = StopRequest(), list[Event]()
    words = [*PASSES, "scan.decide=ask", "scan.wait_s=300", "scan.darks.at=none", "scan.flats.at=end"]
    words += ["scan.offset_views=2", "sample.diameter_mm=0.9"]

    def stop_when_asked(event: Event) -> None:
        if event.data.get("state") == State.ASKING:
            stop.stop()

    ran = Ran(tmp_path, FakeInstrument(), *words, stop=stop, live=live((1.0, 0.1, None)), heard=stop_when_asked)
    assert isinstance(ran.error, ScanStopped) and written(ran) == ([3], [])
    seen: list[str] = []

    def react(event: Event) -> None:
        events.append(event)
        state = event.data.get("state")
        if event.event != "state" or state not in (State.ASKING, State.PAUSED):
            return
        part = ran.folder / "part-2"
        wait_until(lambda: state_of(part) is state)
        seen.append(state)
        ask(ran.folder, Verb.RESUME if state is State.PAUSED else Verb.PAUSE if len(seen) == 1 else Choice.ENOUGH)

    def words_of(scan: Path, output: Path) -> list[str]:
        """A live reconstruction that has the law of the views of the earlier part at once."""
        return [word.replace("while sum(", "while False and sum(") for word in live((1.0, 0.1, None))(scan, output)]

    instrument = FakeInstrument()
    instrument.clock.sleep(1000.0)
    with open_for_resume(ran.folder) as series:
        done = run_scan(series.config, series, [react], instrument=instrument.connected(), live=words_of)
    assert seen == ["asking", "paused", "asking"] and done.status == "complete"
    kinds = [event.data["kind"] for event in events if event.event == "block_started"]
    assert kinds == ["offset_view", "offset_view", "flat"]
    with h5py.File(ran.folder / "joined.h5") as file:
        assert [json.loads(line)["number"] for line in file[layout.DECISIONS].asstr()[()]] == [1]
    with pytest.raises(NothingMissing), open_for_resume(ran.folder):
        ...
