"""A RunEngine flies a simulated scan; its documents are valid and refer to every frame of the file."""

import asyncio
import json
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from beamline.config.load import Config
from tests.beamline import ran
from tests.beamline.ball_scan import small
from tests.beamline.bluesky.heard import Heard
from tests.beamline.bluesky.short_scan import PATHS, SHORT
from tests.beamline.fakes import FakeInstrument, Faults

pytestmark = pytest.mark.skipif(find_spec("ophyd_async") is None, reason="could not find 'ophyd_async'")

FLUSH = "storage.flush_every=4"
N = 2 + 3 + 40 + 3


def _small(*more: str) -> Config:
    return small(*SHORT, *more)


def test_a_scan_flies(engine: Any, tmp_path: Path) -> None:
    from beamline.bluesky.devices import fly, tomography

    heard = Heard()
    engine.subscribe(heard)
    with tomography(_small(), tmp_path) as (scan, _):
        (uid,) = engine(fly(scan, {"sample": "ball"}))
        names = [name for name, _ in heard.all]
        assert names[:2] == ["start", "descriptor"] and names[-1] == "stop"
        (start,), (stop,), (descriptor,) = (heard.of(name) for name in ("start", "stop", "descriptor"))
        assert (start["uid"], start["sample"]) == (uid, "ball")
        assert stop["exit_status"] == "success" and stop["num_events"] == {"primary": N}
        assert descriptor["data_keys"]["tomo"]["shape"] == [32, 40]
        assert "kind: pm16c" in descriptor["configuration"]["tomo"]["data"]["tomo-config"]
        (folder,) = tmp_path.iterdir()
        with h5py.File(folder / "scan.h5") as file:
            written = {key: file[path][()] for key, path in PATHS.items()}
        for key, values in written.items():
            np.testing.assert_array_equal(heard.read(key), values)
        assert len(heard.read("tomo")) == N
        again = Heard()
        engine.subscribe(again)
        engine(fly(scan))
        assert len(again.read("tomo")) == N and len(list(tmp_path.iterdir())) == 2


def test_rows_are_told_while_the_scan_runs_and_an_end_of_the_plan_ends_it_in_order(engine: Any, tmp_path: Path) -> None:
    from beamline.bluesky.devices import fly, tomography

    heard, rows = Heard(), list[int]()
    engine.subscribe(heard)

    def end(name: str, document: dict[str, Any]) -> None:
        if name == "stream_datum":
            rows.append(document["indices"]["stop"])
            with h5py.File(next(tmp_path.iterdir()) / "scan.h5", "r", swmr=True) as file:
                assert file["entry/progress/frames_committed"][()] >= rows[-1]
            if rows[-1] > 8:
                raise RuntimeError("enough")

    settings = _small("simulation.clock=real", "scan.period_s=0.1", "scan.angles={scheme: fixed, views: 900}", FLUSH)
    with tomography(settings, tmp_path) as (scan, _):
        token = engine.subscribe(end)
        with pytest.raises(RuntimeError, match="enough"):
            engine(fly(scan, flush=0.1))
        engine.unsubscribe(token)
        assert heard.of("stop")[0]["exit_status"] == "fail"
        with h5py.File(next(tmp_path.iterdir()) / "scan.h5") as file:
            assert file["entry/progress/status"].asstr()[()] == "stopped"
            assert 8 < len(file["entry/frame_log/kind"]) < 900


@pytest.mark.parametrize("by", ["request", "suspender"])
def test_a_pause_of_the_plan_pauses_the_scan_and_no_view_is_lost(engine: Any, tmp_path: Path, by: str) -> None:
    from bluesky.utils import RunEngineInterrupted

    from beamline.bluesky.devices import fly, tomography

    heard, paused = Heard(), list[str]()
    engine.subscribe(heard)
    lifted = asyncio.Event()  # of a suspender

    def states() -> list[str]:
        lines = (next(tmp_path.iterdir()) / "events.jsonl").read_text().splitlines()
        return [event["state"] for event in map(json.loads, lines) if event["event"] == "state"]

    def lift() -> None:
        deadline = time.monotonic() + 60
        while "paused" not in states() and time.monotonic() < deadline:
            time.sleep(0.05)
        paused.extend(states())
        engine.loop.call_soon_threadsafe(lifted.set)

    def pause(name: str, document: dict[str, Any]) -> None:
        if name == "stream_datum" and document["indices"]["stop"] > 12 and not paused:
            paused.append("asked")
            if by == "request":
                threading.Thread(target=engine.request_pause).start()  # it waits for the loop, which calls here
            else:
                threading.Thread(target=lift).start()
                engine.request_suspend(lifted.wait)

    angles = "scan.angles={scheme: fixed, views: 60, start_deg: 5, span_deg: 20}"  # the stage is slow to come back
    settings = _small("simulation.clock=real", "scan.period_s=0.1", angles, FLUSH)
    with tomography(settings, tmp_path) as (scan, _):
        engine.subscribe(pause)
        if by == "request":
            with pytest.raises(RunEngineInterrupted):
                engine(fly(scan, flush=0.1))
            assert states()[-1] == "paused"
            assert engine.state == "paused"
            engine.resume()
        else:
            engine(fly(scan, flush=0.1))
            assert "paused" in paused
        assert heard.of("stop")[0]["exit_status"] == "success"
        (folder,) = tmp_path.iterdir()  # one scan, not two
        with h5py.File(folder / "scan.h5") as file:
            kinds = file["entry/frame_log/kind"][()]
            assert file["entry/progress/status"].asstr()[()] == "complete"
        assert (kinds == 0).sum() == 60
        np.testing.assert_array_equal(heard.read("tomo-kind"), kinds)


def test_lost_frames_fail_the_plan_and_are_named(engine: Any, tmp_path: Path) -> None:
    from beamline.bluesky.devices import TomoScan, fly

    heard = Heard()
    engine.subscribe(heard)
    scan = TomoScan(ran.small(), tmp_path, instrument=FakeInstrument(Faults(lost={9})).connected())
    with pytest.raises(Exception) as failed:
        engine(fly(scan))
    said = "".join(map(str, [failed.value, failed.value.__cause__, *failed.value.args]))
    assert "LedgerError" in f"{failed.value!r} {failed.value.__cause__!r} {said}"
    assert "1 of 12 projections is missing: 4" in said
    assert heard.of("stop")[0]["exit_status"] == "fail"


def test_the_stage_moves_in_a_plan(engine: Any, tmp_path: Path) -> None:
    from bluesky import plan_stubs, plans

    from beamline.bluesky.devices import tomography

    heard = Heard()
    engine.subscribe(heard)
    with tomography(_small(), tmp_path) as (_, rotation):
        engine(plan_stubs.mv(rotation, 12.5))
        engine(plans.scan([rotation], rotation, 0, 20, 3))
        assert [event["data"]["rotation"] for event in heard.of("event")] == pytest.approx([0, 10, 20])
        with pytest.raises(Exception, match=r"FailedStatus|beyond"):
            engine(plan_stubs.mv(rotation, 4000.0))
        assert asyncio.run(rotation.locate())["readback"] == pytest.approx(20)
