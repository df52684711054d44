"""Subscribed: process variables over PVAccess, whose updates one thread takes, in the order in which they come.

p4p's own subscriptions fall silent for ever where their first update comes before `monitor` has returned, as happens on
a busy computer, and where a callback raises.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any


class Subscribed:
    """Subscriptions until `close`.

    Args:
        takers: by the variable's name, what takes each of its updates (p4p's values, not unwrapped) and its exceptions
            (the server has gone). One that raises misses that update.
        request: pvRequest; None: p4p's.

    Raises:
        ImportError: p4p is not installed.
    """

    def __init__(self, takers: Mapping[str, Callable[[Any], None]], request: str | None = None) -> None:
        from p4p.client.raw import Context

        self._wake, self._over = threading.Event(), False
        self._context = Context("pva", useenv=True, nt=False)  # its unwrapping fails at a compressed frame
        self._subscriptions = [
            (self._context.monitor(name, lambda *ignored: self._wake.set(), request), take)
            for name, take in takers.items()
        ]
        self._thread = threading.Thread(target=self._take, name="subscribed", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End them; no update is taken afterwards."""
        self._over = True
        self._wake.set()
        if self._thread is not threading.current_thread():
            self._thread.join()
        for subscription, _ in self._subscriptions:
            subscription.close()
        self._context.close()

    def _take(self) -> None:
        while not self._over:
            self._wake.wait()
            self._wake.clear()
            for subscription, take in self._subscriptions:
                while not self._over and (update := subscription.pop()) is not None:
                    with suppress(Exception):
                        take(update)
