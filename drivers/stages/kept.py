"""Settings that a driver changes in a controller: as they were found, kept outside the program until they are restored.

A program that is killed leaves its speed in the controller, and the next one would take it for the original.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol, runtime_checkable


class SettingsStore(Protocol):
    """Keeps the settings that a controller was found with, beyond the end of this program."""

    def load(self) -> Mapping[str, str]:
        """Settings that an earlier program found and did not restore; empty if it did."""

    def save(self, found: Mapping[str, str]) -> None: ...

    def clear(self) -> None:
        """Forget the settings: all are restored."""


@runtime_checkable
class RestoresSettings(Protocol):
    """A stage that changes settings of its controller, and restores them when it is closed."""

    def keep_found_settings(self, store: SettingsStore) -> None:
        """From now on they are in `store`, too. Those of an earlier program that died are restored at the end instead
        of what it left, and `describe` says so."""


class FoundSettings:
    """The settings that a controller was found with, by their names there, for the driver that changes them."""

    def __init__(self) -> None:
        self.values: dict[str, str] = {}
        self.notice = ""
        """What an earlier program left, in words; "" if it restored all."""
        self._store: SettingsStore | None = None

    def keep_in(self, store: SettingsStore) -> None:
        """See `RestoresSettings.keep_found_settings`."""
        earlier = {name: value for name, value in store.load().items() if name in self.values}
        changed = {name: self.values[name] for name, value in earlier.items() if self.values[name] != value}
        self.values |= earlier
        store.save(self.values)
        self._store = store
        if changed:
            values = ", ".join(f"{name} {value} for {earlier[name]}" for name, value in changed.items())
            self.notice = (
                f"a program that was killed, or lost this stage, left {values}; "
                "what stood there before is restored at the end"
            )

    def restore(self, write: Callable[[str, str], object]) -> None:
        """Write each setting back, once. If one is refused, the store keeps them all."""
        values, self.values = self.values, {}
        for name, value in values.items():
            write(name, value)
        if self._store is not None:
            self._store.clear()
            self._store = None
