"""The laws of every filter: by hand, on a motor, and behind process variables of a soft IOC."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from uuid import uuid4

import pytest

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import Filter
from drivers.epics.devices import FilterPvs, PvFilter
from drivers.in_beam import ManualFilter, PlacedStage, StagePlaces
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.serial_url import register
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, record_of, serve_pva
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat

PLACES = {"none": 0.0, "Al 1 mm": 1.0, "Cu": 2.0}


@dataclass
class Rig:
    """A filter at a place without a name; `moves` counts what it was told; `broken`: it no longer obeys."""

    filter: Filter
    moves: Callable[[], int]
    break_it: Callable[[], None]


def _by_hand(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    asked, refused = list[str](), list[bool]()

    def ask(request: str) -> None:
        if refused:
            raise DeviceError("operator", "the request was not confirmed")
        asked.append(request)

    return Rig(ManualFilter(ask), lambda: len(asked), lambda: refused.append(True))


def _on_a_motor(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    clock = TickingClock()
    record = record_of(clock, TriggerLine(clock))
    stage = EpicsStage(register(f"epics-{uuid4().hex}", record), flat(EpicsSettings, **USUAL), clock)
    starts = list[float]()
    start = stage.start_move

    def counted(angle: float, speed: float) -> None:
        starts.append(angle)
        start(angle, speed)

    patch.setattr(stage, "start_move", counted)
    degrees = {"none": 10.0, "Al 1 mm": 30.0, "Cu": 50.0}
    places = StagePlaces({name: math.radians(each) for name, each in degrees.items()}, math.radians(10))
    moved = PlacedStage(stage, places, clock)
    opened.callback(moved.close)
    return Rig(moved, lambda: len(starts), lambda: record.state.update({".SPMG": 0.0}))


def _behind_pvs(choices: dict[str, tuple[str, ...]], places: dict[str, float | str]) -> Callable[..., Rig]:
    def made(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
        pytest.importorskip("p4p")
        clock, written, stuck = TickingClock(), list[float | str](), list[bool]()

        def follow(name: str, value: float | str) -> None:
            written.append(value)
            if not stuck:
                served.values["is"] = value

        served = Variables({"wanted": 0.0, "is": 3.0}, choices, follow=follow)
        opened.enter_context(serve_pva(served, clock, patch))
        url = f"pva://{PREFIX}"
        changer = PvFilter(
            FilterPvs(pv=f"{url}wanted", status_pv=f"{url}is", places=places, timeout=5.0, travel=4.0), clock
        )
        opened.callback(changer.close)
        return Rig(changer, lambda: len(written), lambda: stuck.append(True))

    return made


LABELS = ("out", "aluminium", "copper", "between")
KINDS = {
    "by hand": _by_hand,
    "on a motor": _on_a_motor,
    "pv, numbers": _behind_pvs({}, dict(PLACES)),
    "pv, labels": _behind_pvs({"is": LABELS, "wanted": LABELS}, dict(zip(PLACES, LABELS, strict=False))),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS.keys())
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with ExitStack() as opened:
        yield request.param(opened, monkeypatch)


def test_it_goes_to_each_place_once_and_says_where_it_is(rig: Rig) -> None:
    assert rig.filter.place() is None
    for n, place in enumerate((*PLACES, "none"), 1):
        for _ in range(2):
            rig.filter.put(place)
            assert (rig.filter.place(), rig.moves()) == (place, n)


def test_one_that_does_not_obey_is_told_and_is_not_there(rig: Rig) -> None:
    rig.filter.put("none")
    rig.break_it()
    with pytest.raises(DeviceError):
        rig.filter.put("Cu")
    assert rig.filter.place() in ("none", None)  # by hand it is not known


def test_a_status_that_does_not_follow_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as opened:
        rig = KINDS["pv, labels"](opened, monkeypatch)
        rig.break_it()
        said = r"^filter: it did not come to Cu within 4 s.*T:wanted = copper.*T:is is between.*Look where it is"
        with pytest.raises(DeviceTimeout, match=said):
            rig.filter.put("Cu")


@pytest.mark.parametrize("kind", ["on a motor", "pv, numbers"])
def test_an_abort_ends_the_move(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as opened:
        rig = KINDS[kind](opened, monkeypatch)
        if kind != "on a motor":
            rig.break_it()

        def abort() -> None:
            raise KeyboardInterrupt

        assert isinstance(rig.filter, PlacedStage | PvFilter)
        rig.filter.watch(abort)
        with pytest.raises(KeyboardInterrupt):
            rig.filter.put("Cu")
        assert rig.filter.place() is None
