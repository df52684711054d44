"""Refusals: why a scan cannot be reconstructed or corrected, known before any frame is read."""

from __future__ import annotations

from collections.abc import Iterable

from beamline.core.errors import DataError
from beamline.core.sinks import Note, Warn
from beamline.projections.corrections.poses import stated_poses
from beamline.projections.corrections.preparation import Preparation
from beamline.projections.replay import judged_flags
from beamline.projections.selection import Selection
from beamline.projections.usable_views import UsableViews, usable_views
from beamline.storage.readers.base import ScanSource
from beamline.storage.rules import angle_order
from beamline.storage.rules.finding import Finding
from beamline.storage.rules.light import darks_beside_views
from beamline.storage.rules.references import references_usable
from beamline.storage.rules.scan import quantity_stated, references_present, scan_ended, scan_findings
from beamline.storage.rules.treatment import frames_flagged

_OF_A_CIRCLE = angle_order.RULE, "axis"  # rules on what vectors of each view take the place of


def checked_views(source: ScanSource, selection: Selection, warn: Warn) -> UsableViews:
    """The views of a finished scan that may be used, by the flags of the monitor.

    Faults of the file that do not prevent a reconstruction are warned of, and so is the effect of the flags.

    Raises:
        DataError: it cannot be reconstructed; with every reason, and what to do about each.
    """
    asked = selection.step(Preparation)
    judged = judged_flags(source) if asked.judged and source.finished else None
    findings = [*scan_findings(source), *scan_ended(source)]
    findings += [*references_usable(source, asked.accepted), *darks_beside_views(source, asked.accepted)]
    if asked.uses_flags:
        findings += [finding for finding in frames_flagged(source, judged) if finding.severity == "error"]
    if (poses := stated_poses(source, selection)) is not None and poses.vectors is not None:
        findings = [finding for finding in findings if finding.rule not in _OF_A_CIRCLE]
    refuse(source, findings)
    usable = usable_views(source, asked.uses_flags, judged)
    if usable.sentence:
        warn(Note(usable.sentence))
    for finding in findings:
        if finding.severity == "warning":
            warn(finding.message)
    return usable


def refuse(source: ScanSource, findings: Iterable[Finding]) -> None:
    """Raises DataError for the errors among the findings, with what to do about each."""
    reasons = [finding.message for finding in findings if finding.severity == "error"]
    if reasons:
        raise DataError(f"{source.path} cannot be reconstructed. " + "\n  ".join(reasons))


def correction_blockers(source: ScanSource, selection: Selection) -> list[Finding]:
    """Why the frames of a scan that is still growing cannot be corrected."""
    checked = () if selection.step(Preparation).accepted else (references_usable,)
    rules = (quantity_stated, references_present, *checked)
    return [finding for rule in rules for finding in rule(source)]
