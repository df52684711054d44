"""The laws of every monochromator: simulated, by hand, and behind process variables of a soft IOC."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any

import pytest

from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.base.protocols import Monochromator, Watchable
from drivers.epics.devices import EnergyUnit, MonochromatorPvs, PvMonochromator
from drivers.in_beam import ManualMonochromator
from simulators.devices.clock import VirtualClock
from simulators.devices.shutter import SimulatedMonochromator
from tests.drivers.soft_ioc import PREFIX, TickingClock, Variables, serve_pva

ENERGIES = (8.3, 8.34, 8.3485, 8.3)


@dataclass
class Rig:
    """`moves`: the energies in keV that it was told; `broken`: it no longer obeys. `exact`: no encoder between."""

    device: Monochromator
    moves: Callable[[], list[float]]
    break_it: Callable[[], None]
    exact: bool = True


def _by_hand(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    asked, refused = list[float](), list[bool]()

    def ask(request: str) -> None:
        if refused:
            raise DeviceError("operator", "the request was not confirmed")
        asked.append(float(request.split()[-2]))

    return Rig(ManualMonochromator(ask), lambda: asked, lambda: refused.append(True))


def _simulated(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
    """Its scenes are their energies."""
    told, refused = list[float](), list[bool]()

    def scene_at(energy: float) -> Any:
        if refused:
            raise DeviceError("monochromator", "there is no such scene")
        return energy

    show: Any = told.append
    device = SimulatedMonochromator(7.0, scene_at, show, VirtualClock(), settle=2.0)
    return Rig(device, lambda: told, lambda: refused.append(True))


def _behind_pvs(per_kev: float, error_ev: float) -> Callable[..., Rig]:
    """In a unit, with a status that differs from what was asked for by an encoder's error."""

    def made(opened: ExitStack, patch: pytest.MonkeyPatch) -> Rig:
        pytest.importorskip("p4p")
        clock, written, stuck = TickingClock(), list[float](), list[bool]()

        def follow(name: str, value: float | str) -> None:
            if name == "wanted":
                written.append(float(value) / per_kev)
                if not stuck:
                    served.values["is"] = float(value) + error_ev * 1e-3 * per_kev

        served = Variables({"wanted": 0.0, "is": 7.0 * per_kev, "stop": 0.0}, {}, follow=follow)
        opened.enter_context(serve_pva(served, clock, patch))
        names = {"pv": "wanted", "status_pv": "is", "stop_pv": "stop"}
        urls = {name: f"pva://{PREFIX}{variable}" for name, variable in names.items()}
        unit = EnergyUnit.EV if per_kev == 1000 else EnergyUnit.KEV
        device = PvMonochromator(MonochromatorPvs(**urls, unit=unit, timeout=5.0, travel=4.0), clock)
        opened.callback(device.close)
        rig = Rig(device, lambda: written, lambda: stuck.append(True), exact=error_ev == 0)
        rig.served = served  # type: ignore[attr-defined]
        return rig

    return made


KINDS = {
    "by hand": _by_hand,
    "simulated": _simulated,
    "pv, keV": _behind_pvs(1.0, 0.0),
    "pv, eV, off by an encoder": _behind_pvs(1000.0, 0.3),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS.keys())
def rig(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with ExitStack() as opened:
        yield request.param(opened, monkeypatch)


def test_it_goes_to_each_energy_and_says_where_it_is(rig: Rig) -> None:
    for n, energy in enumerate(ENERGIES, 1):
        rig.device.move_to(energy)
        assert rig.device.energy() == (pytest.approx(energy, abs=0 if rig.exact else 5e-4))
        assert rig.moves() == pytest.approx(ENERGIES[:n], abs=1e-9)


def test_one_that_does_not_obey_is_told_and_is_not_there(rig: Rig) -> None:
    rig.device.move_to(8.3)
    rig.break_it()
    with pytest.raises(DeviceError):
        rig.device.move_to(8.4)
    assert rig.device.energy() != pytest.approx(8.4, abs=0.05)


def test_a_status_that_does_not_follow_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as opened:
        rig = KINDS["pv, eV, off by an encoder"](opened, monkeypatch)
        rig.break_it()
        said = r"^monochromator: it did not come to 8\.34 keV.*within 4 s.*wanted = 8340.*is is 7000.*Look where it is"
        with pytest.raises(DeviceTimeout, match=said):
            rig.device.move_to(8.34)


def test_one_that_passes_by_has_not_arrived(monkeypatch: pytest.MonkeyPatch) -> None:
    """It must stay there: at first the status is right and then it is not."""
    with ExitStack() as opened:
        rig = KINDS["pv, keV"](opened, monkeypatch)
        reads, energy = list[float](), rig.device.energy

        def passing() -> float:
            reads.append(energy() or 0.0)
            return 8.34 if len(reads) == 3 else 8.5

        monkeypatch.setattr(rig.device, "energy", passing)
        with pytest.raises(DeviceTimeout):
            rig.device.move_to(8.34)


@pytest.mark.parametrize("kind", ["simulated", "pv, keV"])
def test_an_abort_ends_the_move(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with ExitStack() as opened:
        rig = KINDS[kind](opened, monkeypatch)
        before = rig.device.energy()
        if kind != "simulated":
            rig.break_it()

        def abort() -> None:
            raise KeyboardInterrupt

        assert isinstance(rig.device, Watchable)
        rig.device.watch(abort)
        with pytest.raises(KeyboardInterrupt):
            rig.device.move_to(8.4)
        assert rig.device.energy() == before
        if kind != "simulated":
            assert rig.served.values["stop"] == 1  # type: ignore[attr-defined]
