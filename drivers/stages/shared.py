"""Code that all stages share: positions, stops, waiting for the end of a move, and restoring settings.

A driver changes settings in a controller. Their original values are kept in a file until they are restored. Otherwise,
if a program is killed, its speed would remain in the controller, and the next program would take it for the original.
"""

from __future__ import annotations

import json
from abc import abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from drivers.base.clock import Clock
from drivers.base.errors import DeviceError, DeviceRefused
from drivers.base.protocols import RotationStage, StageLimits
from drivers.stages.travel import Travel


class FoundSettings:
    """The original settings of a controller, by their names in the controller, for the driver that changes them."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}
        self.notice = ""
        """Text on the settings that an earlier program did not restore; "" if it restored all."""
        self._file: Path | None = None

    def keep_in(self, file: Path) -> None:
        """See `LineStage.keep_found_settings`."""
        earlier = {name: value for name, value in _settings_in(file).items() if name in self.values}
        changed = [
            f"{name} {self.values[name]} for {value}" for name, value in earlier.items() if self.values[name] != value
        ]
        self.values |= earlier
        self._file, whole = file, file.with_suffix(".new")
        with suppress(OSError):
            file.parent.mkdir(parents=True, exist_ok=True)
            whole.write_text(json.dumps(self.values, allow_nan=False), encoding="utf-8")
            whole.replace(file)
        if changed:
            self.notice = (
                f"an earlier program that was killed, or lost the connection, changed {', '.join(changed)}; the "
                "original values are restored at the end"
            )

    def restore(self, write: Callable[[str, str], object]) -> None:
        """Write each setting back, once. If one is rejected, all of them remain in the file."""
        values, self.values = self.values, {}
        for name, value in values.items():
            write(name, value)
        if self._file is not None:
            with suppress(OSError):
                self._file.unlink(missing_ok=True)


def _settings_in(file: Path) -> dict[str, str]:
    """Original settings that an earlier program did not restore; empty if it did, or if the file is damaged."""
    with suppress(OSError, ValueError):
        stored = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(stored, dict):
            return {str(name): str(value) for name, value in stored.items()}
    return {}


class Stops:
    """Sends the stops of a stage, so that no stop is lost while a move begins. `count` is the number of stops so far.

    A stop is sent at once, perhaps just before the move command that another thread is about to send. So after its
    command, the thread that starts a move checks whether a stop came meanwhile, and sends the stop again.

    Args:
        send: function that sends a stop (True: without deceleration) and does not wait until the stage has stopped.
    """

    def __init__(self, name: str, send: Callable[[bool], object]) -> None:
        self._name, self._send = name, send
        self.count = self._before = 0
        self._hard = False

    @property
    def came_since(self) -> bool:
        """True if a stop came since the last move began."""
        return self.count != self._before

    def came(self, *, hard: bool) -> None:
        """Call this before the stop is sent. Then either the stop is counted in time, or it is sent after the move
        command."""
        self._hard = hard
        self.count += 1

    @contextmanager
    def none_while(self, purpose: str, since: int | None = None) -> Iterator[None]:
        """Context for the commands that begin a move.

        Args:
            purpose: description of the move for the error message.
            since: the number of stops before the first of several commands.

        Raises:
            DeviceError: a stop came, and has been sent again.
        """
        self._before, problem = self.count if since is None else since, None
        try:
            yield
        except DeviceError as error:
            problem = error
        finally:
            if came := self.came_since:
                self._send(self._hard)
        if came:
            raise DeviceError(
                self._name,
                f"{purpose} was stopped while it was starting",
                advice="Find who stopped the stage before you move it again",
                state="The stop was sent again: the stage has stopped, or is slowing down",
            ) from problem
        if problem is not None:
            raise problem


POLL = 0.02  # s between two status queries of a moving stage
STOP_MARGIN = 2.0  # s after the longest deceleration until a stop counts as failed
Status = TypeVar("Status")


def until_standing(clock: Clock, look: Callable[[], Status], moves: Callable[[Status], bool], timeout: float) -> Status:
    """Wait at most `timeout` s until the stage has stopped; returns the last status.

    Args:
        look: function that reads the status. It is called at least once. moves: function that returns True if the stage
            moves according to a status.
    """
    deadline = clock.now() + timeout
    while moves(status := look()) and (remaining := deadline - clock.now()) > 0:
        clock.sleep(min(POLL, remaining))
    return status


def longest_stop(limits: StageLimits) -> float:
    """Longest time in s that a stage with these limits takes to stop from full speed."""
    return limits.max_speed / limits.acceleration + STOP_MARGIN


FOUND = "found_at_opening"
"""Key of a description: errors that the controller reported at opening, which opening has cleared."""


def found_at_opening(*sentences: str) -> dict[str, str]:
    """The entry of a description with these sentences; no entry if all are empty."""
    joined = "; ".join(filter(None, sentences))
    return {FOUND: joined} if joined else {}


def refuse_another(name: str, wanted: str | None, serial: str) -> None:
    """Raise DeviceError if the device has another serial number than the configured one.

    `wanted` None: any is accepted.
    """
    if wanted is not None and serial != wanted:
        raise DeviceRefused(
            name,
            f"another device answered: its serial number is {serial or 'unknown'}",
            expected=f"{wanted}, as configured",
            advice="Check whether cables or ports were swapped, or correct `serial` in the configuration",
            state="Nothing has moved",
        )


def while_it_moves(name: str, purpose: str, counts: int, reply: str = "") -> DeviceRefused:
    """The error for a request that is possible only at rest, while the stage moves."""
    return DeviceRefused(
        name,
        f"{purpose} is not possible while it moves",
        reply=reply,
        advice="Wait until the move ends, or stop the stage",
        state=f"The current move continues; the stage is at {counts} counts",
    )


@dataclass
class StageOutput:
    """Implements `drivers.base.protocols.DigitalOutput` with the controller of a connected stage."""

    name: str
    set: Callable[[bool], None]
    get: Callable[[], bool | None]


class LineStage(RotationStage):
    """A stage on a serial line; its driver adds the commands of the controller.

    `stop` returns when the stage has stopped, `abort` returns at once. If any thread stops a move, `wait` for this move
    raises an error, so that no thread takes the move as complete. Closing restores the settings that the driver has
    changed.
    """

    _found: FoundSettings
    """Original values of the settings that opening and moves change in the controller."""

    def __init__(self, url: str, settings: Any, clock: Clock, name: str) -> None:
        self.name, self._url, self._clock = name, url, clock
        self._travel, self._stops = Travel(name, settings.limits()), Stops(name, self._send_stop)
        self._target: int | None = None
        self._searching = self._closed = False

    @abstractmethod
    def _counts(self) -> int:
        """The present position in counts, read from the controller."""

    @abstractmethod
    def _send_stop(self, hard: bool) -> str:
        """Send a stop (hard: without deceleration); returns the command."""

    @abstractmethod
    def _release(self) -> None:
        """Restore settings, and close the line even if the connection is lost."""

    @contextmanager
    def _closed_on_failure(self) -> Iterator[None]:
        """Context for opening the controller; closes the line if opening fails."""
        try:
            yield
        except BaseException:
            self.close()
            raise

    @property
    def _aim(self) -> str:
        """Text on the target of the last move or search; "" before the first one."""
        if self._searching:
            return "its reference"
        return "" if self._target is None else self._travel.degrees(self._target)

    @property
    def limits(self) -> StageLimits:
        return self._travel.limits

    def keep_found_settings(self, file: Path) -> None:
        """Keep the original settings of the controller also in `file`, until they are restored.

        If an earlier program died, its original settings are restored at the end, not those that it left, and
        `describe` reports this. If the disk cannot be written, only this protection is missing.
        """
        self._found.keep_in(file)

    def close(self) -> None:
        if not self._closed:
            self._closed = True
            with suppress(DeviceError):  # the line is closed also if the connection is lost
                self._release()

    def to_counts(self, angle: float) -> int:
        return self._travel.to_counts(angle)

    def to_angle(self, counts: int) -> float:
        return self._travel.to_angle(counts)

    def position(self) -> float:
        return self.to_angle(self._counts())

    def stop(self) -> None:
        self._stops.came(hard=False)
        command = self._send_stop(hard=False)
        longest = longest_stop(self.limits)
        if until_standing(self._clock, self.moving, bool, longest):
            raise self._travel.not_stopped(longest, self._counts(), command)

    def abort(self) -> None:
        self._stops.came(hard=True)
        self._send_stop(hard=True)
