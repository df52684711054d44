"""Events: the one vocabulary of what happens in a run; terminal, events.jsonl and report are its sinks."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, TextIO

import numpy as np


@dataclass(frozen=True)
class Event:
    """Something that happened.

    Attributes:
        event: what, one word of the vocabulary below.
        time: s since the Unix epoch.
        data: numbers and strings that belong to it.

    Vocabulary: run_started, state, block_started, frame (throttled), block_done, beam, flag, warning, snapshot,
    progress, scan_done, recon_started, recon_done, tradeoff_started, trial, bench_started, bench, explain, check, done,
    failed.
    What a live reconstruction says carries source="recon".
    """

    event: str
    time: float
    data: Mapping[str, Any] = field(default_factory=lambda: MappingProxyType({}))

    def to_json(self) -> str:
        """One line of JSON; NaN and infinities become null, arrays become lists, paths strings."""
        return json.dumps({"event": self.event, "time": round(self.time, 6), **_plain(self.data)}, allow_nan=False)


Sink = Callable[[Event], None]


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, int | np.integer):
        return int(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, Path):
        return str(value)
    return value if value is None else str(value)


class JsonLines:
    """A sink that writes one JSON line per event and flushes it, so that a crash loses nothing said before."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __call__(self, event: Event) -> None:
        self._stream.write(event.to_json() + "\n")
        self._stream.flush()


def fan_out(*sinks: Sink) -> Sink:
    """One sink that feeds all of `sinks`, in order."""

    def send(event: Event) -> None:
        for sink in sinks:
            sink(event)

    return send
