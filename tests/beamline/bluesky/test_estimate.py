"""A plan of bluesky is estimated by its messages: scans, moves, waits and single frames; no device does anything."""

import math
from collections.abc import Generator, Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from beamline import api
from beamline.plan.timeline import move_seconds
from beamline.scan.dry_run import dry_run
from tests.beamline.ball_scan import small
from tests.beamline.bluesky.short_scan import SHORT

pytestmark = pytest.mark.skipif(find_spec("ophyd_async") is None, reason="could not find 'ophyd_async'")

Plan = Generator[Any, Any, Any]
CONFIG = small(*SHORT)


@pytest.fixture
def devices(tmp_path: Path) -> Iterator[tuple[Any, Any]]:
    from beamline.bluesky.devices import tomography

    with tomography(CONFIG, tmp_path / "runs") as (scan, rotation):
        yield scan, rotation
    assert not (tmp_path / "runs").exists()


def test_a_scan_is_planned_as_its_configuration(devices: tuple[Any, Any], tmp_path: Path) -> None:
    from beamline.bluesky.devices import fly

    (planned,) = api.plan([fly(devices[0])]).scans
    worked = dry_run(CONFIG, tmp_path)
    assert (
        planned.valid
        and planned.needs.duration == worked.needs.duration
        and planned.needs.total_bytes == worked.needs.total_bytes
    )
    assert (planned.source, planned.sample, planned.needs.volume_seconds) == ("plan fly", "battery", 0.0)


def test_moves_and_waits_of_a_plan_count(devices: tuple[Any, Any]) -> None:
    from bluesky import plan_stubs

    from beamline.bluesky.devices import fly

    scan, rotation = devices

    def night() -> Plan:
        for _ in range(3):
            yield from plan_stubs.mv(rotation, 90)
            yield from plan_stubs.mvr(rotation, -90)
            yield from plan_stubs.sleep(60)
            yield from fly(scan)
        yield from plan_stubs.input_plan("Change the sample")

    plan = api.plan([night()])
    *scans, others = plan.scans
    assert len(scans) == 3 and plan.valid and others.source == "plan night, other messages"
    limits = rotation.limits
    there_and_back = 2 * move_seconds(math.pi / 2, limits.max_speed, limits.acceleration)
    assert others.needs.parts == {"move": pytest.approx(3 * there_and_back), "wait": 180.0}
    assert others.needs.operator == (("answer the plan, or resume it", 1),)
    assert plan.needs.duration == pytest.approx(3 * scans[0].needs.duration + others.needs.duration)


def test_frames_of_the_camera_alone_count(tmp_path: Path) -> None:
    from bluesky import plan_stubs, plans
    from ophyd_async.core import TriggerInfo

    from beamline.bluesky.camera import CameraDetector, ShownFrames
    from beamline.bluesky.devices import Rotation
    from beamline.instrument.connect import connect

    with connect(CONFIG) as instrument:
        camera, rotation = CameraDetector(CONFIG, instrument, tmp_path), Rotation(instrument.devices.stage)

        def frames() -> Plan:
            yield from plan_stubs.mv(camera.kind, "flat")
            yield from plans.count([camera], 10)
            yield from plan_stubs.mv(camera.kind, ShownFrames.PROJECTION)
            yield from plans.scan([camera], rotation, 0, 179, 180)
            yield from plan_stubs.prepare(camera, TriggerInfo(number_of_events=5, livetime=0.5))
            yield from plan_stubs.trigger(camera, wait=True)

        plan = api.plan([frames()])
    (planned,) = plan.scans
    needs = dry_run(CONFIG).needs
    row = needs.total_bytes // needs.n_frames
    assert (planned.needs.n_frames, planned.needs.total_bytes, planned.sample) == (195, 195 * row, "battery")
    assert planned.needs.parts["flat"] == pytest.approx(10 * 0.05, rel=0.02)
    assert planned.needs.parts["projection"] == pytest.approx(180 * 0.05 + 5 * 0.5, rel=0.02)
    assert plan.free_bytes > 0 and list(tmp_path.iterdir()) == []


def test_a_plan_that_cannot_be_followed_has_a_fault(devices: tuple[Any, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    from bluesky import Msg, plan_stubs

    from beamline.bluesky import estimate

    scan, rotation = devices
    monkeypatch.setattr(estimate, "MOST", 100)

    def reads() -> Plan:
        reading = yield Msg("read", scan)
        yield from plan_stubs.sleep(reading["value"])

    def endless() -> Plan:
        while True:
            yield from plan_stubs.sleep(1)

    plan = api.plan([reads(), endless(), plan_stubs.mv(rotation, 1000), plan_stubs.mv(rotation, 10)])
    said = [" ".join(map(str, scan.faults)) for scan in plan.scans]
    assert "because the plan raises an error if it gets no measured values (TypeError: 'NoneType' object" in said[0]
    assert said[1] == "the plan may never end: this estimate stopped after 100 messages of the plan"
    assert said[2] == "the plan moves rotation to 1000°, but the limits of the stage are -5° ... 365°"
    assert plan.scans[3].valid
