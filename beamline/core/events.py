"""Events: everything that happens in a run, one class per kind. Sinks (terminal, events.jsonl, log) receive them.

This module has the kinds of events of scans and of all commands; `recon_events` has those of reconstructions.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any, ClassVar, dataclass_transform

from beamline.core.flag import Flag
from beamline.core.run_result import RunResult

KINDS: dict[str, list[type[Event]]] = {}
"""The classes of each kind of event. Each class is added when it is defined. Classes of one kind differ in their
fields."""
SPREAD = "spread"
"""Key of a field's metadata, see `spread`."""


def spread(of: Callable[[Any], Mapping[str, Any]] = vars, made: type = dict, **of_field: Any) -> Any:
    """A field whose values are written into the event's line one by one. They are the values of a mapping, or those
    that `of` returns for an object (by default its attributes).

    Args:
        made: function that makes the field from the values in a line of another process.
    """
    return field(metadata={SPREAD: (of, made)}, **of_field)


@dataclass_transform(frozen_default=True, field_specifiers=(field, spread))
@dataclass(frozen=True, kw_only=True)
class Event:
    """A change during a run. Each kind of event is a frozen dataclass.

    A field that has its default value is not written to JSON.

    Attributes: event: name of the kind of event, as it is written to JSON.
        time: time in s since the Unix epoch, set by the `Announcer` that passes the event on.
        source: "recon" if the event comes from the live reconstruction of a scan.
        scan: in a batch, the scan file that the event belongs to.
    """

    event: ClassVar[str]
    time: float = math.nan
    source: str | None = None
    scan: str | None = None

    def __init_subclass__(cls, event: str = "") -> None:
        dataclass(frozen=True)(cls)
        cls.event = event
        if event:
            KINDS.setdefault(event, []).append(cls)

    @property
    def data(self) -> dict[str, Any]:
        """The values of the event by name, in the form that is written to JSON."""
        values: dict[str, Any] = {}
        own_fields = [each for each in fields(self) if each.name not in ("time", "source", "scan")]
        for each in (*own_fields, *(each for each in fields(Event) if each.name != "time")):
            value = getattr(self, each.name)
            if SPREAD in each.metadata:
                values |= value if isinstance(value, Mapping) else each.metadata[SPREAD][0](value)
            elif value is not each.default:
                values[each.name] = value
        return values

    def to_json(self) -> str:
        """The event as one line of JSON, see `json_of`."""
        return json_of({"event": self.event, "time": round(self.time, 6), **self.data})


Sink = Callable[[Event], None]  # Takes events


def json_of(values: object) -> str:
    """One line of JSON. NaN and infinities become null, arrays become lists, dataclasses objects, and paths strings."""
    from pydantic_core import to_jsonable_python  # imported here, because most commands write no JSON

    from recon.base.json_values import plain

    return json.dumps(to_jsonable_python(values, inf_nan_mode="null", fallback=plain), allow_nan=False)


class RunStarted(Event, event="run_started"):
    """A scan starts; nothing has moved yet. duration: planned duration in s. remarks: remarks of the plan, for
    people."""

    folder: Path
    path: Path
    sample: str
    n_frames: int
    duration: float
    total_bytes: int
    remarks: Sequence[str]


class StateEntered(Event, event="state"):
    """A scan enters a state, or reports a message. In a reconstruction, `state` is the topic of the message.

    Attributes:
        message: a sentence for people; may be empty.
        more: further values by name, for example the picture of the state `ready`.
    """

    state: str
    message: str
    more: Any = spread(default_factory=dict)


class BlockStarted(Event, event="block_started"):
    """A block of darks, flats or projections starts. first_row: row of its first frame in the file. exposure, period:
    in s."""

    kind: str
    mode: str
    n: int
    first_row: int
    exposure: float
    period: float


class BlockDone(Event, event="block_done"):
    """A block has ended. missing: planned triggers without a frame; lost, ignored, extra: see scan.ledger."""

    kind: str
    mode: str
    n: int
    first_row: int
    frames: int
    missing: Sequence[int]
    lost: int
    ignored: int
    extra: int


class FrameStored(Event, event="frame"):
    """A frame was stored in the file. At most ten such events are sent per second. mean: mean counts (not given by
    simulations)."""

    n: int
    of: int
    kind: str
    frames_per_s: float
    mb_per_s: float
    eta_s: float
    mean: float | None = None


class BeamRead(Event, event="beam"):
    """A reading of the beam monitor. read_at: time in s since the Unix epoch."""

    value: float
    unit: str
    read_at: float


class FrameFlagged(Event, event="flag"):
    """A check of the monitor starts to flag frames, or changes the level of its flags."""

    flag: Flag = spread(Flag.event_values, Flag)


class RuleBroken(Event, event="flag"):
    """A file violates a rule of its format."""

    severity: str
    rule: str
    message: str


class Warned(Event, event="warning"):
    """Something needs attention, but the work continues."""

    message: str
    state: str | None = None


class PassEnded(Event, event="pass_ended"):
    """A pass of projections is done. Now the program chooses what to measure next, or asks the operator.

    Attributes:
        number: number of this event, from 1. Such an event follows a pass, laterally offset projections, or projections
            that were taken again.
        n_views: number of projections so far.
        options: what can be measured next, as values of `beamline.plan.choose.PassOption`: choice, frames, seconds,
            dose (as a fraction of the dose of the plan), bytes, and the expected improvement in dB with its range
            (`gain`, `low`, `high`; None: not known).
        recommended: the choice that the program makes, or would make if it need not ask.
        wait: real time in s for which the scan waits for the operator's answer; 0 if nobody is asked.
        remark: a sentence that says why no gain is known; empty if gains are known.
        passes: number of passes that are done. Laterally offset projections, and projections taken again, do not count.
    """

    number: int
    n_views: int
    options: Sequence[Mapping[str, Any]]
    recommended: str
    wait: float = 0.0
    remark: str = ""
    passes: int = 0


class NextChosen(Event, event="next_chosen"):
    """The decision what the scan measures after a pass.

    Attributes:
        number: number of the decision, from 1.
        n_views: number of projections so far.
        passes: as in `PassEnded`.
        choice: a `beamline.plan.passes.Choice`.
        by: who decided: program, operator, or plan (nobody decided, so the scan follows its plan).
        reason: a sentence.
        options: as in `PassEnded`.
        predicted, gained: improvement in dB by an earlier choice: as it was predicted then, and as it is measured now.
            gained_low and gained_high are the ends of the range of the measured improvement. None: not known. judged:
            number of the decision for this earlier choice. dropped: number of planned frames that are not taken because
            of this choice.
    """

    number: int
    n_views: int
    choice: str
    by: str
    reason: str
    options: Sequence[Mapping[str, Any]]
    predicted: float | None = None
    gained: float | None = None
    gained_low: float | None = None
    gained_high: float | None = None
    judged: int | None = None
    passes: int = 0
    dropped: int = 0


class Counted(Event, event="progress"):
    """n of `of` frames, slices, projections or axes are done. `stage` names the work."""

    stage: str
    n: int
    of: int
    per_s: float
    eta_s: float


class PhaseReached(Event, event="progress"):
    """A phase of the work starts (n is 0), or n of `of` items are done. `counted` names the items. A value that is not
    known is None."""

    stage: str
    counted: str
    phase: str
    n: int
    of: int
    per_s: float | None
    eta_s: float | None


class TrialReached(Event, event="progress"):
    """n of `of` trials, scans or runs are done, and the one named `label` starts."""

    stage: str
    n: int
    of: int
    label: str
    eta_s: float | None
    per_min: float


class KernelsCompiled(Event, event="progress"):
    """Kernels were compiled. The values are their number and the time in seconds."""

    stage: str
    n: int
    seconds: float


class ScanDone(Event, event="scan_done"):
    """The scan file is closed."""

    result: RunResult = spread(RunResult.file_values, RunResult)


class Listed(Event):
    """An event whose values are printed as they are. values: a mapping or a dataclass."""

    values: Any = spread()


class StepsListed(Listed, event="explain"):
    """The steps in which a frame of a scene is computed, in order, and the effects that the scene does not use."""


class DeviceRead(Listed, event="device"):
    """Status of a device for `beamline check --connect`: `name`, `fault` ("" if it answers) and its values."""


class RunDone(Event, event="done"):
    """A run has ended successfully. result: a `RunResult`, or its values by name if the event was read from the output
    of another process."""

    folder: Path
    result: Any = spread(RunResult.run_values)


class Done(Listed, event="done"):
    """A command has ended successfully. values: its results."""


class Failed(Event, event="failed"):
    """A command has failed. folder: folder of the run; more: further values by name, such as the plan of a queue that
    contains a scan that cannot run."""

    message: str
    exit_code: int | None = None
    folder: Path | None = None
    more: Any = spread(default_factory=dict)
