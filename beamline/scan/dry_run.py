"""Dry run: plans a scan from its configuration without devices, and says what it needs and which limits it exceeds."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from beamline.config.faults import quantities
from beamline.config.load import Config, each_scan
from beamline.config.planned import camera_settings, plan_of
from beamline.core.errors import ConfigError
from beamline.core.files import broken_link
from beamline.core.machine import free_memory
from beamline.core.quantities import doubt, doubt_span
from beamline.core.text import count, size
from beamline.instrument import connect
from beamline.plan.limits import ROOM
from beamline.plan.needs import OperatorRequest, ScanNeeds, all_needs
from beamline.plan.plan import ScanPlan, Timeline
from beamline.plan.timeline import describe as describe_timeline
from beamline.plan.timeline import hms_text, work_out
from beamline.scan.live_plan import better_order, live_need
from beamline.storage.writer_lock import no_locks
from drivers.base.frame import FrameKind
from drivers.base.protocols import CameraTiming, StageLimits, TriggerSource
from drivers.orca_quest import PITCH_MM
from recon.methods import streams

# Function that removes from a plan the frames that earlier files of the same scan contain
Remaining = Callable[[ScanPlan], ScanPlan]


def all_of(plan: ScanPlan) -> ScanPlan:
    """Returns the whole plan unchanged."""
    return plan


class EnergyNeeds(NamedTuple):
    """Time (s) and disk space (bytes) of the scan at one energy (keV)."""

    kev: float
    duration: float
    total_bytes: int


class StateNeeds(NamedTuple):
    """Time (s) and disk space (bytes) of the scan of one state, by its number."""

    state: int
    duration: float
    total_bytes: int


@dataclass(frozen=True, eq=False)
class DryRun:
    """A scan that was planned without devices: plan, timeline, limits of stage and camera, and free bytes on the disk.

    For a series it is the first scan; `energies` or `states` lists the needs of each scan.

    Attributes:
        disk: an existing folder on the disk of the file.
        needs: needs of all scans, including the time between states.
        state_interval: time in s from the beginning of one state to the beginning of the next; None: another
            program decides when a state begins.
    """

    plan: ScanPlan
    timeline: Timeline
    stage: StageLimits
    camera: CameraTiming
    free_bytes: int
    needs: ScanNeeds
    disk: Path
    energies: tuple[EnergyNeeds, ...] = ()
    states: tuple[StateNeeds, ...] = ()
    state_interval: float | None = None

    def lines(self) -> list[str]:
        """The plan as lines of text. Violations are not included; `refuse_violations` reports them."""
        lines = describe_timeline(self.plan, self.timeline, self.stage, self.camera, free_bytes=self.free_bytes)
        each, needs = self.energies, self.needs
        if each:
            lowest = each[0].kev
            highest = each[-1].kev
            sentence = (
                f"{len(each)}, {lowest:.7g} to {highest:.7g} keV, one scan like this at each energy: "
                f"{hms_text(needs.duration)} and {size(needs.total_bytes)} in total (without the moves of the "
                "monochromator)"
            )
            lines.append(f"{'energies':<10}{sentence}")
        if self.states:
            lines.append(f"{'states':<10}{self._states_in_words()}")
        if needs.dose_gy is not None:
            lines.append(f"{'dose':<10}{needs.dose_gy:.4g} Gy")
        return [*lines, *(f"{'operator':<10}{request}, {count(times, 'time')}" for request, times in needs.operator)]

    def _states_in_words(self) -> str:
        longest, interval = max(needs.duration for needs in self.states), self.state_interval
        when = "at the next `beamline resume`" if interval is None else f"one every {hms_text(interval)}"
        is_late = interval is not None and longest > interval
        more = f"; a state takes {hms_text(longest)}, so the next state begins later than planned" if is_late else ""
        return (
            f"{len(self.states)}, with one scan of this plan for each state, {when}: {hms_text(self.needs.duration)} "
            f"and {size(self.needs.total_bytes)} in total{more}"
        )

    def data(self) -> Mapping[str, Any]:
        """The numbers in these lines, for programs, in s, rad, bytes and pixels."""
        timeline, views = self.timeline, self.timeline.views
        return {
            **self.needs.data(),
            "remarks": timeline.remarks,
            "duration": timeline.duration,
            "n_frames": timeline.n_frames,
            "total_bytes": timeline.total_bytes,
            "free_bytes": self.free_bytes,
            "step_counts": timeline.step_counts,
            "step": timeline.step,
            "speed": views.speed,
            "taxi": views.taxi,
            "blur_px": timeline.blur_px,
            "skew_px": timeline.skew_px,
            "min_period": self.camera.min_period,
            "energies": [need._asdict() for need in self.energies],
            "states": [need._asdict() for need in self.states],
            "blocks": [
                {"kind": b.kind.name.lower(), "mode": b.mode, "first_row": row, "n": b.n_to_take}
                for b, row in zip(timeline.blocks, timeline.first_rows, strict=True)
            ],
        }


def doubts(config: Config) -> list[str]:
    """Warnings about implausible values, for example because of a wrong unit; empty if all values are plausible."""
    theta = np.degrees(plan_of(config).angles)
    span = float(np.ptp(theta))
    spans = getattr(config.scan.angles, "span_deg", span), span, span * theta.size / max(theta.size - 1, 1)
    sentences = [
        *(doubt(".".join(key), value) for key, value in quantities(config.model_dump(exclude={"simulation"}))),
        next(filter(None, map(doubt_span, spans)), ""),
        _doubt_optics(config),
    ]
    return [sentence for sentence in dict.fromkeys(sentences) if sentence]


# ratio of the pixel size at the sample to the pixel size of the camera; no optics demagnifies by more
_DEMAGNIFIED = 100


def _doubt_optics(config: Config) -> str:
    """A sentence if pixel size and distance do not match the camera, for example because of a wrong unit; otherwise
    empty.
    """
    optics, camera, camera_pixel_um = config.optics, config.devices.camera, 1e3 * PITCH_MM
    settings = camera_settings(config, config.scan.exposure_s, TriggerSource.EXTERNAL)
    # half of the width of the field of view, in mm
    half_width = 5e-4 * optics.pixel_size_um * camera.binning * camera.timing_of(settings).shape[1]
    field_of_view = 2 * half_width
    if optics.pixel_size_um > _DEMAGNIFIED * camera_pixel_um:
        return (
            f"optics.pixel_size_um is {optics.pixel_size_um:g} um, but the camera's pixels are {camera_pixel_um:g} um: "
            f"the field of view would be {field_of_view:.4g} mm wide. The setting is the size of an unbinned pixel "
            "at the sample, in um. Was the value given in nm?"
        )
    return (
        f"optics.distance_mm is {optics.distance_mm:g} mm from sample to detector, less than half the field of view "
        f"of {field_of_view:.4g} mm: a sample as wide as the field of view could not rotate there. Was the value given "
        "in m?"
        if optics.distance_mm and optics.distance_mm < half_width
        else ""
    )


def dry_run(
    settings: Config,
    runs: Path | None = None,
    remaining: Remaining = all_of,
    complete: Collection[float | None] = (),
    locks: Callable[[Path], str] = no_locks,
) -> DryRun:
    """Compute the plan of a configuration without devices.

    Args:
        runs: where the file would be, for the free disk space; default: the configured folder.
        remaining: function that returns the part of the plan that must still be taken.
        complete: energies (keV), or numbers of states, whose scans in the series are already complete; at least one
            scan must be left.
        locks: function that returns what is wrong with the file locks in a folder, such as `no_locks`, which writes to
            the folder.

    Raises:
        ConfigError: angles, scene or device settings are impossible. Exceeded limits do not raise an error here; they
            are listed as violations of the timeline.
    """
    configs = [config for config in each_scan(settings) if (config.scan.state or config.scan.energy) not in complete]
    if settings.scan.energies is not None and len(configs) > 1:  # a scene is read at both ends of the energy range
        connect.describe(max(configs, key=lambda config: config.scan.energy or 0.0))
    stage, camera, to_counts = connect.describe(min(configs, key=lambda config: config.scan.energy or 0.0))
    disk = disk_of(runs or Path(settings.storage.folder))
    free = shutil.disk_usage(disk).free
    plans = [remaining(plan_of(config)) for config in configs]
    timelines = [
        timeline_of(config, plan, stage, to_counts, camera, free) for config, plan in zip(configs, plans, strict=True)
    ]
    dry_runs = [
        DryRun(plan, timeline, stage, camera, free, _needs(config, timeline), disk)
        for config, plan, timeline in zip(configs, plans, timelines, strict=True)
    ]
    planned = _of_series(settings, configs, dry_runs) if settings.series else dry_runs[0]
    return replace(planned, timeline=with_lock_violation(planned.timeline, locks(disk)))


def _copied(config: Config) -> frozenset[str]:
    """The names of the kinds of frames that are copied."""
    return frozenset({FrameKind.DARK.name, FrameKind.FLAT.name} if config.copies_references else ())


def _needs(config: Config, timeline: Timeline) -> ScanNeeds:
    """The needs of one scan. Darks and flats that are copied from the first state take no time."""
    rate = config.optics.dose_rate_gy_s
    copied = _copied(config)
    return ScanNeeds(
        {part: seconds for part, seconds in timeline.parts.items() if part.upper() not in copied},
        timeline.n_frames,
        timeline.total_bytes,
        dose_gy=None if rate is None else rate * timeline.in_beam,
        volume_seconds=config.recon.seconds if config.recon.live else 0.0,
        operator=tuple(_requests(config, timeline)),
    )


def _requests(config: Config, timeline: Timeline) -> Iterator[OperatorRequest]:
    """The requests that the scan will make to the operator."""
    by_hand, copied = config.devices.by_hand, _copied(config)
    kinds = [block.kind for block in timeline.blocks if block.n_to_take and block.kind.name not in copied]
    # the position of the shutter at the start is not known
    opened = [None, *(kind is not FrameKind.DARK for kind in kinds), False]
    moved_out = [False, *(kind is FrameKind.FLAT for kind in kinds if kind is not FrameKind.DARK), False]
    for device, states, request in (
        ("filter", [None, *filter(None, [config.scan.filter])], f"put the filter {config.scan.filter} into the beam"),
        ("monochromator", [None, *filter(None, [config.scan.energy])], "set the monochromator"),
        ("shutter", opened, "open or close the shutter"),
        ("sample_mover", moved_out, "move the sample out of the beam or back"),
    ):
        if device in by_hand and (times := sum(before != after for before, after in pairwise(states))):
            yield OperatorRequest(request, times)
    if config.scan.decide == "ask":
        passes = math.ceil(timeline.plan.n_views / (timeline.plan.pass_views or timeline.plan.n_views))
        yield OperatorRequest("decide what to measure next", max(len(timeline.views.trains), passes))


def _of_series(settings: Config, configs: Sequence[Config], dry_runs: Sequence[DryRun]) -> DryRun:
    """The first of several scans, with the needs and the violations of all of them."""
    states, needs_of_scans = settings.scan.states, [scan.needs for scan in dry_runs]
    total = replace(dry_runs[0], needs=all_needs(needs_of_scans))
    if states is None:
        sizes = ((scan.timeline.duration, scan.timeline.total_bytes) for scan in dry_runs)
        needs = [EnergyNeeds(one.scan.energy or 0.0, *totals) for one, totals in zip(configs, sizes, strict=True)]
        total = replace(total, energies=tuple(needs))
    else:
        numbers = [config.scan.state or 0 for config in configs]
        state_needs = [
            StateNeeds(n, one.duration, one.total_bytes) for n, one in zip(numbers, needs_of_scans, strict=True)
        ]
        breaks = sum(max((states.every_s or 0.0) - one.duration, 0.0) for one in needs_of_scans[:-1])
        parts = {**total.needs.parts, "wait": breaks}
        needs_with_waits = replace(total.needs, parts=parts)
        total = replace(total, states=tuple(state_needs), state_interval=states.every_s, needs=needs_with_waits)
    kind = "energies" if states is None else "states"
    violations = dict.fromkeys(limit for scan in dry_runs for limit in scan.timeline.violations)
    if total.needs.total_bytes * ROOM > total.free_bytes:
        violations[
            f"free some space, choose another storage.folder, or set fewer {kind}: {len(dry_runs)} {kind} need "
            f"{size(total.needs.total_bytes)} plus a reserve of a tenth, and the disk has {size(total.free_bytes)} "
            "free"
        ] = None
    return replace(total, timeline=replace(total.timeline, violations=tuple(violations)))


def timeline_of(
    config: Config,
    plan: ScanPlan,
    stage: StageLimits,
    to_counts: Callable[[float], int],
    camera: CameraTiming,
    free: int,
) -> Timeline:
    """The timeline, with a remark on the live volume."""
    axis_col, preview_bin, method = config.optics.axis_col, config.storage.preview_bin, config.recon.chosen_method
    timeline = work_out(plan, stage, to_counts, camera, axis_col=axis_col, preview_bin=preview_bin, free_bytes=free)
    if not config.recon.live or not streams(method):
        return timeline
    remark = live_need(camera.shape, plan.n_views, free_memory())
    return replace(timeline, remarks=(*timeline.remarks, remark, *better_order(plan)))


def with_lock_violation(timeline: Timeline, no_locking: str) -> Timeline:
    """The plan, with an additional violation if files in its folder cannot be locked."""
    return replace(timeline, violations=(*timeline.violations, no_locking)) if no_locking else timeline


def refuse_violations(timeline: Timeline) -> None:
    """Raise ConfigError with all violated limits, if there are any."""
    violations = timeline.violations
    if len(violations) == 1:
        first_limit = violations[0]
        raise ConfigError(f"a limit is exceeded, nothing was started: {first_limit}.")
    if violations:
        raise ConfigError("\n  ".join([f"{len(violations)} limits are exceeded, nothing was started:", *violations]))


def disk_of(folder: Path) -> Path:
    """`folder` if it exists, otherwise its nearest existing parent, which is on the same disk.

    Raises: ConfigError: a file has the name of the folder, or the disk does not exist.
    """
    folder = folder.absolute()
    if link := broken_link(folder):
        raise ConfigError(
            f"choose another folder, because runs cannot be written to {folder}: {link} Nothing was started."
        )
    existing = next((place for place in (folder, *folder.parents) if place.exists()), None)
    if existing is None or not existing.is_dir():
        problem = "no such disk" if existing is None else f"a file at {existing}"
        raise ConfigError(
            f"choose another folder, because runs cannot be written to {folder}: there is {problem}. "
            "Nothing was started."
        )
    return existing
