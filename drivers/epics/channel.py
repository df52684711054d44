"""EPICS process variables, and records with their fields, over PVAccess (p4p) or Channel Access (aioca)."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, NoReturn, Protocol

from drivers.base.errors import DeviceError, DeviceRefused, DeviceTimeout

INVALID = 3
"""The severity of a value that the IOC does not guarantee: its hardware does not answer, or the value was never set."""
UNREACHABLE = (
    "Check the name of the process variable, whether its IOC is running, and which hosts are searched "
    "(EPICS_PVA_ADDR_LIST for pva://, EPICS_CA_ADDR_LIST for ca://)"
)


@dataclass(frozen=True)
class PvValue:
    """A value, with its label if it is a choice, and its alarm: 0 none, 1 minor, 2 major, 3 INVALID."""

    value: float | str
    label: str = ""
    severity: int = 0

    @property
    def text(self) -> str:
        """The value as text, without its label."""
        return self.value if isinstance(self.value, str) else repr(self.value)

    def __str__(self) -> str:
        return self.label or f"{self.value}"

    def is_one(self, wanted: float | str) -> bool:
        """True if the value equals this number, text or label."""
        return wanted in (self.value, self.label) if self.label else self.value == wanted


class ProcessVariable(Protocol):
    """A process variable, or a record whose fields have suffixes such as ".RBV"."""

    name: str

    def read(self, *suffixes: str) -> list[PvValue]:
        """The present values of the fields.

        Raises DeviceTimeout if one does not answer in time, DeviceError if one cannot be read.
        """

    def write(self, suffix: str, value: float | str) -> None:
        """Set a value; later reads see it. Raises DeviceTimeout, or DeviceError if the variable rejects the value.

        Channel Access does not report whether a disabled record (DISP) accepted the value; only a later read shows it.
        """

    def close(self) -> None:
        """Close the channel; later reads and writes raise DeviceError."""


def open_channel(url: str, device: str, timeout: float) -> ProcessVariable:
    """Open the channel of pva://NAME or ca://NAME, without reading it yet.

    Args:
        device: name of the device in errors.
        timeout: time limit in s of each read and write.

    Raises:
        DeviceRefused: the address is of another kind.
        DeviceError: the library for this kind is not installed.
    """
    if problem := url_problem(url):
        raise DeviceRefused(device, problem, state="Nothing was asked")
    scheme, _, name = url.partition("://")
    try:
        return OPENERS[scheme.lower()](name, device, timeout)
    except (ImportError, OSError, ValueError) as error:  # ValueError: the library was compiled for another numpy
        library = getattr(error, "name", None) or f"for {scheme}://"
        raise DeviceError(
            device,
            f"{url} needs the library {library}, which cannot be loaded ({error})",
            advice='pip install "splatline[epics]"',
            state="Nothing was asked",
        ) from error


def url_problem(url: str) -> str:
    """The reason why a URL is not the address of a process variable; "" if it is one."""
    scheme, _, name = url.partition("://")
    legal = scheme.lower() in OPENERS and name and not any(letter.isspace() for letter in name)
    return "" if legal else f"{url!r} does not name a process variable; expected pva://NAME (PVAccess) or ca://NAME"


def refuse_invalid(device: str, name: str, value: PvValue, state: str = "") -> None:
    """Raise DeviceError if a value has an INVALID alarm."""
    if value.severity >= INVALID:
        raise DeviceError(
            device,
            f"{name} has an INVALID alarm: its IOC does not guarantee the value",
            reply=str(value),
            advice="Check the record in its control screen: the IOC lost its controller, or the record was never set",
            state=state,
        )


@dataclass(frozen=True)
class _Errors:
    """The errors of a channel."""

    device: str
    timeout: float

    def silent(self, names: str) -> NoReturn:
        raise DeviceTimeout(
            self.device, f"no answer within {self.timeout:g} s", request=names, advice=UNREACHABLE
        ) from None

    def refused(self, request: str, reply: object) -> NoReturn:
        raise DeviceError(
            self.device,
            "the process variable rejected the request",
            request=request,
            reply=str(reply),
            advice="Check the access rights of the process variable, and whether its record is enabled (DISP, DISA)",
        ) from None

    def closed(self) -> NoReturn:
        raise DeviceError(self.device, "the connection is closed", state="Nothing was asked")


class PvaChannel:
    """Implements `ProcessVariable` over PVAccess."""

    def __init__(self, name: str, device: str, timeout: float) -> None:
        from p4p.client.thread import Context

        self.name, self._errors, self._timeout = name, _Errors(device, timeout), timeout
        self._context: Any = Context("pva")

    def read(self, *suffixes: str) -> list[PvValue]:
        names = [self.name + suffix for suffix in suffixes]
        values = self._asked().get(names, timeout=self._timeout, throw=False)
        if silent := [name for name, value in zip(names, values, strict=True) if _is_silence(value)]:
            self._errors.silent(", ".join(silent))
        for name, value in zip(names, values, strict=True):
            if isinstance(value, Exception):
                self._errors.refused(name, value)
        return [_of_pva(value) for value in values]

    def write(self, suffix: str, value: float | str) -> None:
        name = self.name + suffix
        (result,) = self._asked().put([name], [value], timeout=self._timeout, throw=False)
        if _is_silence(result):
            self._errors.silent(name)
        if isinstance(result, Exception):
            self._errors.refused(f"{name} = {value}", result)

    def close(self) -> None:
        context, self._context = self._context, None
        if context is not None:
            context.close()

    def _asked(self) -> Any:
        return self._context if self._context is not None else self._errors.closed()


def _is_silence(answer: object) -> bool:
    from p4p.client.thread import Disconnected

    return isinstance(answer, TimeoutError | Disconnected)


def _of_pva(answer: Any) -> PvValue:
    severity = int(getattr(answer, "severity", 0))
    choices: Any = getattr(getattr(answer, "raw", None), "value", None)
    if (labels := getattr(choices, "choices", None)) is not None:
        index = int(choices.index)
        return PvValue(float(index), labels[index] if index < len(labels) else "", severity)
    # str() of a p4p text begins with its time
    return PvValue(str.__str__(answer) if isinstance(answer, str) else float(answer), "", severity)


_CA_SILENCE = (80, 192)  # ECA_TIMEOUT and ECA_DISCONN of caerr.h


class CaChannel:
    """Implements `ProcessVariable` over Channel Access."""

    def __init__(self, name: str, device: str, timeout: float) -> None:
        import aioca

        self.name, self._errors, self._timeout = name, _Errors(device, timeout), timeout
        self._ca: Any = aioca

    def read(self, *suffixes: str) -> list[PvValue]:
        ca, names = self._asked(), [self.name + suffix for suffix in suffixes]
        values = waited(ca.caget(names, format=ca.FORMAT_CTRL, timeout=self._timeout, throw=False))
        if silent := [value.name for value in values if not value.ok and value.errorcode in _CA_SILENCE]:
            self._errors.silent(", ".join(silent))
        for value in values:
            if not value.ok:
                self._errors.refused(value.name, value)
        return [_of_ca(value) for value in values]

    def write(self, suffix: str, value: float | str) -> None:
        ca, name = self._asked(), self.name + suffix
        result = waited(ca.caput(name, value, timeout=self._timeout, throw=False))
        if not result.ok:
            if result.errorcode in _CA_SILENCE:
                self._errors.silent(name)
            self._errors.refused(f"{name} = {value}", result)

    def close(self) -> None:
        """Close the channel. The process keeps its circuits, because other channels may use them."""
        self._ca = None

    def _asked(self) -> Any:
        return self._ca if self._ca is not None else self._errors.closed()


def _of_ca(answer: Any) -> PvValue:
    severity = int(answer.severity)
    if (labels := getattr(answer, "enums", None)) is not None:
        index = int(answer)
        return PvValue(float(index), labels[index] if index < len(labels) else "", severity)
    return PvValue(str(answer) if isinstance(answer, str) else float(answer), "", severity)


@cache
def _loop() -> asyncio.AbstractEventLoop:
    """The event loop of Channel Access in a separate thread; one for each process."""
    loop = asyncio.new_event_loop()
    threading.Thread(target=loop.run_forever, name="channel access", daemon=True).start()
    return loop


def waited(asked: Any) -> Any:
    """The result of a coroutine of aioca. All of them run in one thread, because aioca's channels belong to it."""
    return asyncio.run_coroutine_threadsafe(asked, _loop()).result()


OPENERS: dict[str, Callable[[str, str, float], ProcessVariable]] = {"pva": PvaChannel, "ca": CaChannel}
"""For each scheme of a URL, the function that opens it. A simulation adds its own scheme."""
