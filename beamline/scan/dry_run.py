"""Dry run: a configuration worked out to its timeline and its limits, without a word to any device."""

from __future__ import annotations

import math
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from beamline.config import load as config
from beamline.config.load import Config
from beamline.core.errors import ConfigError
from beamline.instrument import connect as devices
from beamline.monitor.flag import Context
from beamline.monitor.watch import start as start_monitor
from beamline.plan import timeline
from beamline.plan.plan import ScanPlan, Timeline
from drivers.protocols import CameraTiming, StageLimits


@dataclass(frozen=True, eq=False)
class DryRun:
    """A scan as it would be: plan, timeline, what the devices can do, and the room on the disk in bytes."""

    plan: ScanPlan
    timeline: Timeline
    stage: StageLimits
    camera: CameraTiming
    free_bytes: int

    def lines(self) -> list[str]:
        """For a human; the violations come last."""
        return timeline.describe(self.plan, self.timeline, self.stage, self.camera, free_bytes=self.free_bytes)

    def data(self) -> Mapping[str, Any]:
        """For a program: the numbers behind the lines, in s, rad, bytes and pixels."""
        worked = self.timeline
        views = worked.views
        return {
            "remarks": worked.remarks,
            "duration": worked.duration,
            "n_frames": worked.n_frames,
            "total_bytes": worked.total_bytes,
            "free_bytes": self.free_bytes,
            "step_counts": worked.step_counts,
            "step": worked.step,
            "speed": views.speed,
            "taxi": views.taxi,
            "blur_px": worked.blur_px,
            "skew_px": worked.skew_px,
            "min_period": self.camera.min_period,
            "blocks": [
                {"kind": b.kind.name.lower(), "mode": b.mode, "first_row": b.first_row, "n": b.n} for b in worked.blocks
            ],
        }


def dry_run(settings: Config) -> DryRun:
    """Work a configuration out.

    Raises:
        ConfigError: angles, a scene, monitor thresholds or device settings that cannot be. Broken limits are no error
            here: they are the timeline's violations.
    """
    plan = config.plan_of(settings)
    stage, camera, to_counts = devices.describe(settings)
    start_monitor(Context(2**camera.bits - 1, math.prod(camera.shape)), settings.monitor.thresholds)
    free = free_bytes(Path(settings.storage.folder))
    worked = timeline.work_out(
        plan,
        stage,
        to_counts,
        camera,
        axis_col=settings.optics.axis_col,
        preview_bin=settings.storage.preview_bin,
        free_bytes=free,
    )
    return DryRun(plan, worked, stage, camera, free)


def refuse_violations(worked: Timeline) -> None:
    """Raises ConfigError with every broken limit, where there is one."""
    broken = worked.violations
    if len(broken) == 1:
        raise ConfigError(f"a limit is violated, nothing was started: {broken[0]}.")
    if broken:
        raise ConfigError("\n  ".join([f"{len(broken)} limits are violated, nothing was started:", *broken]))


def free_bytes(folder: Path) -> int:
    """Room on the disk that holds `folder`, or will hold it once it is made.

    Raises:
        ConfigError: a file stands in the way, or there is no such disk.
    """
    folder = folder.absolute()
    there = next((place for place in (folder, *folder.parents) if place.exists()), None)
    if there is None or not there.is_dir():
        problem = "no such disk" if there is None else f"a file at {there}"
        raise ConfigError(
            f"runs cannot go to {folder}: there is {problem}. Choose another folder; nothing was started."
        )
    return shutil.disk_usage(there).free
