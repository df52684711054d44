"""Estimate of a bluesky plan. The messages of the plan are read without a RunEngine, so that no device does
anything."""

from __future__ import annotations

import math
from collections.abc import Generator
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from bluesky import Msg

from beamline.bluesky.camera import CameraDetector, ShownFrames
from beamline.bluesky.devices import Rotation, TomoScan
from beamline.config.planned import camera_settings
from beamline.core.errors import ConfigError
from beamline.core.text import degrees
from beamline.plan.needs import OperatorRequest, ScanNeeds, all_needs
from beamline.plan.timeline import move_seconds, row_bytes
from beamline.scan.dry_run import disk_of
from beamline.scan.queue_plan import PlannedScan, ScanFault
from beamline.scan.queue_planning import plan_of_config
from drivers.base.protocols import TriggerSource

MOST = 500_000
"""Number of messages (about a second) after which a plan counts as endless."""
_DONE = SimpleNamespace(done=True, success=True, exception=lambda timeout=None: None)
"""Answer to the plan for a message that a RunEngine would answer with a status."""


@dataclass
class _Messages:
    """The needs of the messages of a plan apart from whole scans: moves of the stage, waits, and frames of the
    camera."""

    needs: list[ScanNeeds] = field(default_factory=list)
    faults: list[ScanFault] = field(default_factory=list)
    sample: str = ""
    disk: Path | None = None
    places: dict[Rotation, float] = field(default_factory=dict)
    values: dict[int, Any] = field(default_factory=dict)  # last value that was set or prepared, by the id of the device

    def take(self, message: Msg) -> Any:
        """Add a message, and return the reply that the plan expects."""
        argument: Any = message.args[0] if message.args else None
        match message.command, message.obj:
            case "set", Rotation() as stage:
                self._move(stage, math.radians(float(argument)))
            case "set" | "prepare", device:
                self.values[id(device)] = argument
            case "trigger" | "kickoff", CameraDetector() as camera:
                self._expose(camera)
            case "sleep", _:
                self.needs.append(ScanNeeds({"wait": float(argument)}))
            case "input" | "pause", _:
                self.needs.append(ScanNeeds(operator=(OperatorRequest("answer the plan, or resume it", 1),)))
            case "locate", Rotation() as stage:
                angle_deg = math.degrees(self.places.get(stage, stage.radians))
                return {"setpoint": angle_deg, "readback": angle_deg}
            case "kickoff" | "complete" | "wait", _:
                pass
            case _:
                return None
        return _DONE

    def _move(self, stage: Rotation, target: float) -> None:
        limits, position = stage.limits, self.places.get(stage, stage.radians)
        self.places[stage] = target
        self.needs.append(ScanNeeds({"move": move_seconds(target - position, limits.max_speed, limits.acceleration)}))
        if not limits.low <= target <= limits.high:
            reach = f"{degrees(limits.low)} ... {degrees(limits.high)}"
            self.faults.append(
                ScanFault(f"the plan moves {stage.name} to {degrees(target)}, but the limits of the stage are {reach}")
            )

    def _expose(self, camera: CameraDetector) -> None:
        """Add the frames of a trigger. Their number is that for which the camera was prepared last."""
        config, requested = camera.config, self.values.get(id(camera))
        exposure = getattr(requested, "livetime", 0.0) or config.scan.exposure_s
        timing = config.devices.camera.timing_of(camera_settings(config, exposure, TriggerSource.SOFTWARE))
        n = getattr(requested, "number_of_exposures", 1)
        period = max(timing.min_period, exposure + getattr(requested, "deadtime", 0.0))
        kind = ShownFrames(self.values.get(id(camera.kind), ShownFrames.PROJECTION))
        size = row_bytes(timing.shape, config.storage.preview_bin)
        self.needs.append(ScanNeeds({kind.value: n * period}, n, n * size))
        self.sample, self.disk = config.sample.name, disk_of(camera.runs)


def scans_of(plan: Generator[Any, Any, Any]) -> tuple[PlannedScan, ...]:
    """The scans that a bluesky plan starts, in order. The last item contains all other messages of the plan.

    The plan gets no measured values. If it makes a decision with a value that it reads from a device, the plan cannot
    be followed, and the result states this fault. Moves are counted one after the other. The plan cannot be run
    afterwards.
    """
    source, scans, others = f"plan {getattr(plan, '__name__', '')}".rstrip(), list[PlannedScan](), _Messages()
    reply = None
    try:
        for _ in range(MOST):
            message = plan.send(reply)
            if message.command == "kickoff" and isinstance(message.obj, TomoScan):
                planned = plan_of_config(message.obj.config, message.obj.runs, source)
                # this item makes no volume
                scans.append(replace(planned, needs=replace(planned.needs, volume_seconds=0.0)))
            reply = others.take(message)
        others.faults.append(
            ScanFault(f"the plan may never end: this estimate stopped after {MOST} messages of the plan")
        )
    except StopIteration:
        pass
    except ConfigError as error:
        others.faults.append(ScanFault(str(error)))
    except Exception as error:  # an error of the plan, because it got no measured values
        error_text = f"{type(error).__name__}: {error}"
        others.faults.append(
            ScanFault(
                f"the plan cannot be predicted, because the plan raises an error if it gets no measured values "
                f"({error_text})"
            )
        )
    if others.needs or others.faults:
        source_text = f"{source}, other messages" if scans else source
        needs = all_needs(others.needs)
        scans.append(PlannedScan(source_text, others.sample, tuple(others.faults), needs=needs, disk=others.disk))
    return tuple(scans)
