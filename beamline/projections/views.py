"""Determines the usable projections of a scan and their geometry, as it is stated and as corrections change it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from beamline.core.durations import Phases
from beamline.core.errors import DataError
from beamline.core.sinks import Note, Warn
from beamline.projections.corrections.poses import poses_of, stated_poses
from beamline.projections.corrections.width import Width
from beamline.projections.preparation import Preparation
from beamline.projections.protocols import GeometryLearnt, PlaceStep, ViewMotion
from beamline.projections.registry import geometry_steps, in_order
from beamline.projections.replay import judged_flags
from beamline.projections.selection import SelectedScan, Selection, choose_views
from beamline.projections.step import StepDone
from beamline.projections.usable_views import UsableViews, usable_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.readers.transforms import WRAPPED
from beamline.storage.rules import Finding, angles_shown
from beamline.storage.rules.evidence import EvidenceRequest, ScanEvidence
from beamline.storage.rules.flag_policy import FLAGS
from beamline.storage.rules.scan import VARYING, findings_of
from beamline.storage.rules.stored_order import SINOGRAM
from recon.base.geometry import Geometry


def stated_geometry(scan: SelectedScan) -> Geometry:
    """The geometry of the selected projections that the scan and the options state, before any frame is read.

    If the axis must still be found, it is assumed to be in the middle. Projections without an angle or a pose are left
    out.

    Raises:
        ConfigError: the selection does not fit the scan.
        DataError: the poses do not fit the scan.
    """
    source, selection, frames = scan.source, scan.selection, scan.source.table.views_with_angles
    poses = poses_of(scan, frames)
    if poses is not None:
        frames = frames[poses.stated(frames)]
    frames = frames[choose_views(scan, frames)]
    stated = source.axis_col if selection.axis_col is None else selection.axis_col
    axis_col = (source.shape[1] - 1) / 2 if stated is None else stated
    geometry = selection.geometry(axis_col, source.table.angles[frames])
    if poses is not None:
        geometry = poses.corrected(geometry, frames)
    return selection.step(Width).rays(scan, geometry)[0]


@dataclass(eq=False)
class ViewGeometry:
    """The geometry of projections, from the stated angles and from what the steps find and change.

    Attributes:
        stated_axis: the column of the rotation axis before calibration.
        moved: position of the sample in the projections, by the name of the step that found it.
        width: what was done about the width of rays.
        learnt: what was calibrated, by the name of the step.
    """

    scan: SelectedScan
    stated_axis: float
    moved: dict[str, ViewMotion] = field(default_factory=dict)
    width: StepDone = field(default_factory=StepDone)
    learnt: dict[str, GeometryLearnt] = field(default_factory=dict)

    @property
    def axis_col(self) -> float:
        """The column of the rotation axis."""
        return self.stated_axis + sum(learnt.axis for learnt in self.learnt.values())

    @property
    def done(self) -> dict[str, StepDone]:
        """What the steps did, by their names."""
        calibrated = {name: learnt.done for name, learnt in self.learnt.items()}
        return {**{name: motion.done for name, motion in self.moved.items()}, Width.name: self.width, **calibrated}

    def find_motion(self, usable: UsableViews, warn: Warn, phases: Phases) -> UsableViews:
        """Let each step find the position of the sample. Returns the projections among `usable` that remain usable."""
        for step in (step for step in in_order(self.scan.selection) if isinstance(step, PlaceStep)):
            motion = step.place(self.scan, usable, self.stated_axis, phases.progress)
            self.moved[step.name] = motion
            if motion.done.sentence:
                warn(motion.done.sentence)
            usable = usable.only(motion.frames)
        return usable

    def calibrate(self, view_ids: NDArray[np.int64], phases: Phases) -> None:
        """Calibrate the geometry from these projections, if the user requested it."""
        for step in geometry_steps(self.scan.selection):
            if step.geometry:
                phases.enter("calibration", "steps")
                learnt = step.learn(self.scan, view_ids, self.uncalibrated, phases.progress)
                self.learnt[step.name] = learnt

    def uncalibrated(self, part: SelectedScan, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of projections of a part of the scan, before calibration."""
        source = part.source
        geometry = part.selection.geometry(self.stated_axis, source.table.angles[view_ids])
        if (aside := source.table.aside) is not None:
            geometry = replace(geometry, shifts=np.outer(aside[view_ids] / geometry.pixel_pitch, (1.0, 0.0)))
        for motion in self.moved.values():
            geometry = motion.corrected(geometry, view_ids)
        geometry, self.width = part.selection.step(Width).rays(part, geometry)
        return geometry

    def of(self, view_ids: NDArray[np.int64]) -> Geometry:
        """The geometry of projections."""
        geometry = self.uncalibrated(self.scan, view_ids)
        for learnt in self.learnt.values():
            geometry = learnt.corrected(geometry, view_ids)
        return geometry


_ROTATION_RULES = angles_shown.ORDER, "axis"  # these rules do not apply if vectors state the pose of each projection


def select(source: ScanSource, selection: Selection) -> SelectedScan:
    """Combine a scan with a selection; called once per job. If the user requested that the monitor checks the frames,
    it does so when their flags are first used.

    Raises:
        ConfigError: as `Selection.of`.
    """
    preparation = selection.step(Preparation)
    judge = judged_flags if preparation.judged and source.finished else None
    evidence = ScanEvidence(source, EvidenceRequest(preparation.accepted, selection.cone, judge))
    return SelectedScan(evidence, selection.of(source))


def checked_views(scan: SelectedScan, warn: Warn) -> UsableViews:
    """The usable projections of a finished scan, according to the flags of the monitor.

    Faults of the file that do not prevent a reconstruction become warnings. The effect of the flags is also reported as
    a warning.

    Raises:
        DataError: the scan cannot be reconstructed; the message lists every reason and what to do about it.
    """
    selection, preparation = scan.selection, scan.selection.step(Preparation)
    by_option = {
        "central-column": selection.axis_col,
        "central-row": selection.central_row,
        VARYING: selection.asked.pixel_size_mm if selection.asked.cone is None else selection.asked.cone,
    }
    findings = [hit for hit in findings_of(scan.evidence) if by_option.get(hit.rule) is None]
    findings = [hit for hit in findings if hit.rule != FLAGS or (preparation.uses_flags and hit.severity == "error")]
    if (poses := stated_poses(scan)) is not None and poses.vectors is not None:
        findings = [finding for finding in findings if finding.rule not in _ROTATION_RULES]
    refuse(scan.source, findings)
    usable = usable_views(scan.evidence, preparation.uses_flags)
    if usable.sentence:
        warn(Note(usable.sentence))
    for finding in findings:
        if finding.severity == "warning" or finding.rule == SINOGRAM:
            warn(finding.message if finding.severity == "warning" else Note(finding.message))
    return usable


def refuse(source: ScanSource, findings: Iterable[Finding]) -> None:
    """Raise DataError for the errors among the findings, and say for each what to do. If counts overflowed, only this
    is reported, because it explains all other errors.
    """
    errors = [finding for finding in findings if finding.severity == "error"]
    wrapped = [finding for finding in errors if finding.rule == WRAPPED]
    reasons = [finding.message for finding in wrapped or errors]
    if reasons:
        raise DataError(f"{source.path} cannot be reconstructed. " + "\n  ".join(reasons))
