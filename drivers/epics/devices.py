"""Shutter, filter, monochromator and beam monitor that are controlled by EPICS process variables."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from enum import StrEnum

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceTimeout
from drivers.epics.channel import ProcessVariable, PvValue, open_channel, refuse_invalid, url_problem
from recon.base.setting import CheckedSettings, setting

POLL = 0.05  # s between two reads while a shutter moves
NOT_KNOWN = "It is not known whether the shutter is open: check the shutter before anybody goes near the beam"


class _PvDevice:
    """A device that is controlled by process variables, which are opened together."""

    def __init__(self, name: str, clock: Clock, timeout: float) -> None:
        """`timeout`: time limit in s of each read and write."""
        self.name, self._clock, self._timeout = name, clock, timeout
        self._check: Callable[[], None] = lambda: None
        self.disconnect: Callable[[], None]
        """Close the connection; the device does not move."""

    def watch(self, check: Callable[[], None]) -> None:
        """From now on, call `check` repeatedly during a move.

        An exception from `check` ends the wait, and stops the device if possible.
        """
        self._check = check

    @contextmanager
    def _opening(self, *urls: str) -> Iterator[list[ProcessVariable]]:
        """Open the process variables at these addresses. An error in the context closes them again."""
        with ExitStack() as opened:
            channels = [open_channel(url, self.name, self._timeout) for url in urls]
            for channel in channels:
                opened.callback(channel.close)
            yield channels
            self.disconnect = opened.pop_all().close

    def _waited(self, arrived: Callable[[], bool], travel: float, check: Callable[[], None] | None = None) -> bool:
        """Wait until the device has arrived, but at most `travel` s. Returns True if it has arrived."""
        deadline = self._clock.now() + travel
        while not (there := arrived()) and self._clock.now() < deadline:
            (check or self._check)()
            self._clock.sleep(POLL)
        return there


@dataclass(frozen=True)
class ShutterPvs(CheckedSettings):
    """The process variables of a shutter, each as pva://NAME or ca://NAME; times in s."""

    open_pv: str = setting(problem=url_problem)
    status_pv: str = setting(
        doc="Process variable with the state of the shutter blade. If the IOC has no such variable, give open_pv.",
        problem=url_problem,
    )
    close_pv: str | None = setting(
        None,
        "Process variable that closes the shutter; null: open_pv opens and closes the shutter.",
        problem=url_problem,
    )
    open_value: float | str = setting(
        1.0, "Value that is written to open_pv to open the shutter: a number, a text or a label."
    )
    close_value: float | str = setting(0.0)
    status_open: float | str = setting(
        1.0, "Value or label of the status while the shutter is open; any other value counts as closed."
    )
    timeout: float = setting(
        2.0, "Longest time in s that the driver waits for an answer of the IOC.", unit="s", gt=0, le=1e6
    )
    travel: float = setting(10.0, "Longest time until the status changes.", unit="s", gt=0, le=1e6)


class PvShutter(_PvDevice):
    """Implements `drivers.base.protocols.Shutter`. Opening and closing end when the status confirms it.

    `close` always writes, even if the status says closed.

    Raises:
        DeviceRefused: an address is not a process variable. DeviceTimeout, DeviceError: the status does not answer.
    """

    by_hand = False

    def __init__(self, pvs: ShutterPvs, clock: Clock, name: str = "shutter") -> None:
        super().__init__(name, clock, pvs.timeout)
        self._pvs = pvs
        with self._opening(pvs.open_pv, pvs.close_pv or pvs.open_pv, pvs.status_pv) as channels:
            self._opener, self._closer, self._status = channels
            _ = self.is_open()

    def open(self) -> None:
        if not self.is_open():
            self._put(self._opener, self._pvs.open_value, True, self._check)

    def close(self) -> None:
        self._put(self._closer, self._pvs.close_value, False, lambda: None)

    def is_open(self) -> bool:
        """True if the status is open. Raises DeviceTimeout without an answer, DeviceError if the alarm is INVALID."""
        (status,) = self._status.read("")
        refuse_invalid(self.name, self._status.name, status, NOT_KNOWN)
        return status.is_one(self._pvs.status_open)

    def _put(self, channel: ProcessVariable, value: float | str, wanted: bool, check: Callable[[], None]) -> None:
        request = f"{channel.name} = {value}"
        try:
            channel.write("", value)
            arrived = self._waited(lambda: self.is_open() is wanted, self._pvs.travel, check)
        except DeviceError as cause:
            raise cause.told_by(self.name, cause.problem, request=request, state=NOT_KNOWN) from cause
        if not arrived:
            (status,) = self._status.read("")
            raise DeviceTimeout(
                self.name,
                f"it did not {'open' if wanted else 'close'} within {self._pvs.travel:g} s",
                request=request,
                reply=f"{self._status.name} is {status}",
                expected=f"{'' if wanted else 'another value than '}{self._pvs.status_open}",
                advice="Check the permit and the interlock of the shutter, check that the ring has beam, and that "
                "this computer has write access",
                state=NOT_KNOWN,
            )


@dataclass(frozen=True, kw_only=True)
class FilterPvs(CheckedSettings):
    """The process variables of a filter, as pva://NAME or ca://NAME; times in s."""

    pv: str = setting(
        doc="Process variable that moves the filter. The driver writes the value of the wanted position: a number, "
        "a text or a label.",
        problem=url_problem,
    )
    status_pv: str | None = setting(
        None,
        "Process variable that reads back the position of the filter, with the same values as pv; null: pv.",
        problem=url_problem,
    )
    places: Mapping[str, float | str] = setting(doc="Name: value.", min_length=1)
    timeout: float = setting(
        2.0, "Longest time in s that the driver waits for an answer of the IOC.", unit="s", gt=0, le=1e6
    )
    travel: float = setting(30.0, "Longest time until the status changes.", unit="s", gt=0, le=1e6)


class PvFilter(_PvDevice):
    """Implements `drivers.base.protocols.Filter`. A move ends when the status confirms it.

    Raises:
        DeviceRefused: an address is not a process variable. DeviceTimeout, DeviceError: the status does not answer.
    """

    def __init__(self, pvs: FilterPvs, clock: Clock, name: str = "filter") -> None:
        super().__init__(name, clock, pvs.timeout)
        self._pvs = pvs
        with self._opening(pvs.pv, pvs.status_pv or pvs.pv) as (self._setter, self._status):
            _ = self.place()
        self.close = self.disconnect

    def place(self) -> str | None:
        status = self._status_now()
        return next((name for name, value in self._pvs.places.items() if status.is_one(value)), None)

    def put(self, place: str) -> None:
        value = self._pvs.places[place]
        if self.place() == place:
            return
        self._setter.write("", value)
        if not self._waited(lambda: self.place() == place, self._pvs.travel):
            raise DeviceTimeout(
                self.name,
                f"the filter did not reach {place} within {self._pvs.travel:g} s",
                request=f"{self._setter.name} = {value}",
                reply=f"{self._status.name} is {self._status_now()}",
                expected=f"{value}",
                advice="Check the position of the filter, and whether this computer may write to the process variables",
            )

    def remember_place(self) -> Callable[[], str]:
        """See `drivers.base.protocols.Rechecked`."""
        before = self._status_now()

        def moved() -> str:
            now = self._status_now()
            return "" if now.value == before.value else f"{self._status.name} was {before}, and is now {now}"

        return moved

    def _status_now(self) -> PvValue:
        return _valid(self._status, self.name)


class EnergyUnit(StrEnum):
    KEV = "keV"
    EV = "eV"


@dataclass(frozen=True, kw_only=True)
class MonochromatorPvs(CheckedSettings):
    """The process variables of a monochromator, as pva://NAME or ca://NAME; times in s, `tolerance` in eV."""

    pv: str = setting(
        doc="Process variable to which the energy is written, for example VAL of a motor record.", problem=url_problem
    )
    status_pv: str = setting(doc="Process variable with the energy itself.", problem=url_problem)
    stop_pv: str | None = setting(
        None,
        "Process variable that stops the monochromator if 1 is written to it; null: the driver cannot stop the "
        "monochromator.",
        problem=url_problem,
    )
    unit: EnergyUnit = setting(EnergyUnit.KEV, "Unit of pv and status_pv.")
    tolerance: float = setting(
        0.5,
        "Largest allowed difference in eV between the measured energy and the requested energy.",
        unit="ev",
        gt=0,
        le=1e4,
    )
    settle: float = setting(
        1.0,
        "Time in s for which the energy must stay within tolerance_ev before a move counts as finished.",
        unit="s",
        ge=0,
        le=1e6,
    )
    timeout: float = setting(
        2.0, "Longest time in s that the driver waits for an answer of the IOC.", unit="s", gt=0, le=1e6
    )
    travel: float = setting(60.0, "Longest time of a move.", unit="s", gt=0, le=1e6)

    @property
    def per_kev(self) -> float:
        """The value of the process variables at 1 keV."""
        return 1e3 if self.unit is EnergyUnit.EV else 1.0


class PvMonochromator(_PvDevice):
    """Implements `drivers.base.protocols.Monochromator`. A move ends when the status has stayed at the energy for
    `settle`.

    Raises:
        DeviceRefused: an address is not a process variable. DeviceTimeout, DeviceError: the status does not answer.
    """

    def __init__(self, pvs: MonochromatorPvs, clock: Clock, name: str = "monochromator") -> None:
        super().__init__(name, clock, pvs.timeout)
        self._pvs = pvs
        with self._opening(pvs.pv, pvs.status_pv, *([pvs.stop_pv] if pvs.stop_pv else [])) as channels:
            self._setter, self._status, *self._stoppers = channels
            _ = self.energy()
        self.close = self.disconnect

    def energy(self) -> float:
        status = _valid(self._status, self.name)
        try:
            return float(status.value) / self._pvs.per_kev
        except ValueError:
            raise DeviceError(
                self.name, f"{self._status.name} is not a number", reply=str(status), expected="an energy"
            ) from None

    def move_to(self, energy: float) -> None:
        pvs, clock = self._pvs, self._clock
        wanted = energy * pvs.per_kev
        self._setter.write("", wanted)
        deadline = clock.now() + pvs.travel
        try:
            while self._waited(lambda: self._is_at(energy), deadline - clock.now()):
                if not self._waited(lambda: not self._is_at(energy), pvs.settle):
                    return
        except DeviceError:
            raise
        except BaseException:
            self.stop()
            raise
        raise DeviceTimeout(
            self.name,
            f"the monochromator did not reach {energy:.7g} keV and stay there within {pvs.travel:g} s",
            request=f"{self._setter.name} = {wanted:.7g}",
            reply=f"{self._status.name} is {_valid(self._status, self.name)}",
            expected=f"{wanted:.7g}, within {pvs.tolerance * 1e-3 * pvs.per_kev:g}",
            advice=(
                "Check the energy that the monochromator reports, and whether this computer may write to the process "
                "variables"
            ),
        )

    def stop(self) -> None:
        """Stop the monochromator if it can be stopped. Raises DeviceError."""
        for stopper in self._stoppers:
            stopper.write("", 1)

    def remember_place(self) -> Callable[[], str]:
        """See `drivers.base.protocols.Rechecked`.

        As after a move, a deviation of the energy counts only if it lasts at least `settle`.
        """
        before = self.energy()

        def moved() -> str:
            if self._waited(lambda: self._is_at(before), self._pvs.settle):
                return ""
            return f"the monochromator was at {before:.7g} keV, and is now at {self.energy():.7g} keV"

        return moved

    def _is_at(self, energy: float) -> bool:
        return abs(self.energy() - energy) <= self._pvs.tolerance * 1e-3


def _valid(channel: ProcessVariable, device: str) -> PvValue:
    (value,) = channel.read("")
    refuse_invalid(device, channel.name, value)
    return value


class PvSource:
    """Implements `drivers.beam_monitors.TextSource`: the number of a process variable as text.

    Raises:
        DeviceRefused: the address is not a process variable.
    """

    def __init__(self, url: str, timeout: float, name: str = "beam monitor") -> None:
        self.request, self._name = url, name
        self._channel = open_channel(url, name, timeout)

    def text(self) -> str:
        return _valid(self._channel, self._name).text

    def close(self) -> None:
        self._channel.close()
