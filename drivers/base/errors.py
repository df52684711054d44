"""DeviceError: an error of a device. It contains the request, the reply, the expected reply, advice, and the state of
the device."""

from __future__ import annotations

from copyreg import __newobj__  # type: ignore[attr-defined]
from typing import Any


class DeviceError(Exception):
    """A device did not carry out a request.

    The message is one readable paragraph. The parts of the message are also attributes.

    Attributes:
        device: name of the device.
        problem: what went wrong, in words.
        request: the text that was sent to the device.
        reply: the answer of the device.
        expected: the reply that was expected.
        advice: what the operator should do.
        state: which changes and moves were made before the error, and which were not.
        wire: the last lines sent and received.
    """

    def __init__(
        self,
        device: str,
        problem: str,
        *,
        request: str = "",
        reply: str = "",
        expected: str = "",
        advice: str = "",
        state: str = "",
        wire: str = "",
    ) -> None:
        self.device, self.problem, self.request, self.reply = device, problem, request, reply
        self.expected, self.advice, self.state, self.wire = expected, advice, state, wire
        formatted = (
            ("Asked {!r}", request),
            ("Answered {!r}", reply),
            ("Expected {}", expected),
            ("{}", advice),
            ("{}", state),
            ("On the wire: {}", wire),
        )
        parts = [f"{device}: {problem}", *(form.format(text) for form, text in formatted if text)]
        super().__init__(". ".join(part.rstrip(".") for part in parts) + ".")

    def __reduce__(self) -> tuple[Any, ...]:
        # Worker processes send the error with its parts, so that the message is not composed again.
        return __newobj__, (type(self), *self.args), vars(self)

    def told_by(self, device: str, problem: str, **changed: str) -> DeviceError:
        """A copy of this error with another device and another problem, for example if a stage reports an error of its
        serial port as its own. `changed` are other parts of the error to replace, such as `advice`.
        """
        parts = ("request", "reply", "expected", "advice", "state", "wire")
        return type(self)(device, problem, **({part: getattr(self, part) for part in parts} | changed))


class DeviceTimeout(DeviceError):  # noqa: N818 - the name that operators know
    """A device did not answer, or no frame arrived, in the time allowed."""


class DeviceRefused(DeviceError):  # noqa: N818
    """The device (or its driver) rejected a setting; nothing has changed."""
