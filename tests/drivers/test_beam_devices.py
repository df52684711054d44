"""Common tests of filters and monochromators: by hand, by motor, simulated, and behind a soft IOC."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from typing import Any
from uuid import uuid4

import pytest

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import Filter, Monochromator, Watchable
from drivers.epics.devices import EnergyUnit, FilterPvs, MonochromatorPvs, PvFilter, PvMonochromator
from drivers.in_beam import ManualFilter, ManualMonochromator, PlacedStage, StagePlaces
from drivers.stages.epics.stage import EpicsSettings, EpicsStage
from simulators.devices.clock import VirtualClock
from simulators.devices.in_beam import SimulatedMonochromator
from simulators.devices.trigger_line import TriggerLine
from simulators.wires.wire import register
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, record_of, serve_pva
from tests.drivers.stages.epics.test_conformance import USUAL
from tests.drivers.stages.flat_settings import flat

FILTERS = ("none", "Al 1 mm", "Cu", "none")
ENERGIES = (8.3, 8.34, 8.3485, 8.3)
URL = f"pva://{PREFIX}"
LABELS = ("out", "aluminium", "copper", "between")


@dataclass
class Rig:
    """A device that stands nowhere in particular.

    Attributes:
        moves: what it was told, one entry a move.
        break_it: from then on it no longer obeys.
        error: by which its status differs from what it was told, as by an encoder.
        served: variables of the IOC.
    """

    device: Filter | Monochromator
    moves: list[Any]
    break_it: Callable[[], None]
    error: float = 0.0
    served: dict[str, float | str] = field(default_factory=dict)

    def put(self, place: Any) -> None:
        (self.device.put if isinstance(self.device, FILTER) else self.device.move_to)(place)  # type: ignore[union-attr]

    def place(self) -> Any:
        return (self.device.place if isinstance(self.device, FILTER) else self.device.energy)()  # type: ignore[union-attr]


FILTER = ManualFilter | PlacedStage | PvFilter


def _by_hand(make: Callable[[Callable[[str], None]], Any]) -> Callable[..., Rig]:
    def made(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
        asked, refused = list[str](), list[bool]()

        def ask(request: str) -> None:
            if refused:
                raise DeviceError("operator", "the request was not confirmed")
            asked.append(request)

        return Rig(make(ask), asked, lambda: refused.append(True))

    return made


def _on_a_motor(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    clock, starts = TickingClock(), list[float]()
    record = record_of(clock, TriggerLine(clock))
    stage = EpicsStage(register(f"epics-{uuid4().hex}", record), flat(EpicsSettings, **USUAL), clock)
    start = stage.start_move
    patch.setattr(stage, "start_move", lambda angle, speed: (starts.append(angle), start(angle, speed)))
    degrees = {"none": 10.0, "Al 1 mm": 30.0, "Cu": 50.0}
    places = StagePlaces({name: math.radians(each) for name, each in degrees.items()}, math.radians(10))
    moved = PlacedStage(stage, places, clock)
    opened.callback(moved.close)
    return Rig(moved, starts, lambda: record.state.update({".SPMG": 0.0}))


def _simulated(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    """Its scenes are their energies."""
    told, refused = list[Any](), list[bool]()

    def scene_at(energy: float) -> Any:
        if refused:
            raise DeviceError("monochromator", "there is no such scene")
        return energy

    device = SimulatedMonochromator(7.0, scene_at, told.append, VirtualClock(), settle=2.0)
    return Rig(device, told, lambda: refused.append(True))


def _behind_pvs(
    make: Callable[[Any], Any], values: dict[str, float | str], choices: dict[str, tuple[str, ...]], error: float = 0.0
) -> Callable[..., Rig]:
    """With a status that follows, off by `error`."""

    def made(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
        pytest.importorskip("p4p")
        clock, written, stuck = TickingClock(), list[Any](), list[bool]()

        def follow(name: str, value: float | str) -> None:
            if name == "wanted":
                written.append(value)
                if not stuck:
                    served.values["is"] = value + error if isinstance(value, float) else value

        served = Variables(dict(values), choices, follow=follow)
        opened.enter_context(serve_pva(served, clock, patch))
        device = make(clock)
        opened.callback(device.close)
        return Rig(device, written, lambda: stuck.append(True), error, served.values)

    return made


def _pv_filter(places: dict[str, float | str]) -> Callable[[Any], PvFilter]:
    pvs = FilterPvs(pv=f"{URL}wanted", status_pv=f"{URL}is", places=places, timeout=5.0, travel=4.0)
    return lambda clock: PvFilter(pvs, clock)


def _pv_monochromator(unit: EnergyUnit) -> Callable[[Any], PvMonochromator]:
    urls: dict[str, Any] = {
        name: f"{URL}{end}" for name, end in (("pv", "wanted"), ("status_pv", "is"), ("stop_pv", "stop"))
    }
    pvs = MonochromatorPvs(**urls, unit=unit, timeout=5.0, travel=4.0)
    return lambda clock: PvMonochromator(pvs, clock)


OUTSIDE: dict[str, float | str] = {"wanted": 0.0, "is": 3.0}
NUMBERS: dict[str, float | str] = {"none": 0.0, "Al 1 mm": 1.0, "Cu": 2.0}
KINDS: dict[str, Callable[[ExitStack, pytest.MonkeyPatch], Rig]] = {
    "filter by hand": _by_hand(ManualFilter),
    "filter on a motor": _on_a_motor,
    "filter, numbers": _behind_pvs(_pv_filter(NUMBERS), OUTSIDE, {}),
    "filter, labels": _behind_pvs(
        _pv_filter(dict(zip(NUMBERS, LABELS, strict=False))), OUTSIDE, {"is": LABELS, "wanted": LABELS}
    ),
    "energy by hand": _by_hand(ManualMonochromator),
    "energy, simulated": _simulated,
    "energy, keV": _behind_pvs(_pv_monochromator(EnergyUnit.KEV), {"wanted": 0.0, "is": 7.0, "stop": 0.0}, {}),
    "energy, eV, off by an encoder": _behind_pvs(
        _pv_monochromator(EnergyUnit.EV), {"wanted": 0.0, "is": 7000.0, "stop": 0.0}, {}, error=0.3
    ),
}


@pytest.fixture(params=list(KINDS.values()), ids=list(KINDS))
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with ExitStack() as opened:
        yield request.param(opened, monkeypatch)


def only(*kinds: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("rig", [KINDS[kind] for kind in kinds], ids=kinds, indirect=True)


def test_it_goes_to_each_place_once_and_says_where_it_is(rig: Rig) -> None:
    filters = isinstance(rig.device, FILTER)
    assert not filters or rig.place() is None
    for n, place in enumerate(FILTERS if filters else ENERGIES, 1):
        for _ in range(2 if filters else 1):
            rig.put(place)
        assert rig.place() == (place if filters else pytest.approx(place, abs=5e-4 if rig.error else 0))
        assert len(rig.moves) == n
        assert not str(rig.moves[-1]).endswith(".") or f"{place}" in rig.moves[-1]  # a request to the operator


def test_one_that_does_not_obey_is_told_and_is_not_there(rig: Rig) -> None:
    first, then = ("none", "Cu") if isinstance(rig.device, FILTER) else (8.3, 8.4)
    rig.put(first)
    rig.break_it()
    with pytest.raises(DeviceError):
        rig.put(then)
    stands = rig.place()  # by hand it is not known
    assert stands is None or stands == (first if isinstance(first, str) else pytest.approx(first, abs=1e-3))


@only("filter, labels")
def test_a_filter_that_does_not_follow_is_named(rig: Rig) -> None:
    rig.break_it()
    said = r"^filter: the filter did not reach Cu within 4 s.*T:wanted = copper.*T:is is between.*Check the "
    with pytest.raises(DeviceTimeout, match=said):
        rig.put("Cu")


@only("energy, eV, off by an encoder")
def test_a_monochromator_that_does_not_follow_is_named(rig: Rig) -> None:
    rig.break_it()
    said = (
        r"^monochromator: the monochromator did not reach 8\.34 keV.*within 4 s.*wanted = 8340.*is is 7000."
        r"*Check the "
    )
    with pytest.raises(DeviceTimeout, match=said):
        rig.put(8.34)


@only("energy, keV")
def test_one_that_passes_by_has_not_arrived(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    """It must stay there: at first the status is right and then it is not."""
    reads = list[float]()

    def passing() -> float:
        reads.append(0.0)
        return 8.34 if len(reads) == 3 else 8.5

    monkeypatch.setattr(rig.device, "energy", passing)
    with pytest.raises(DeviceTimeout):
        rig.put(8.34)


@only("filter on a motor", "filter, numbers", "energy, simulated", "energy, keV")
def test_an_abort_ends_the_move(rig: Rig) -> None:
    before = rig.place()
    if isinstance(rig.device, PvFilter | PvMonochromator):
        rig.break_it()

    def abort() -> None:
        raise KeyboardInterrupt

    assert isinstance(rig.device, Watchable)
    rig.device.watch(abort)
    with pytest.raises(KeyboardInterrupt):
        rig.put("Cu" if isinstance(rig.device, FILTER) else 8.4)
    assert rig.place() == before
    assert rig.served.get("stop", 1) == 1
