"""Section `references` of the configuration: limits of darks and flats, and what a fault does to a scan.

The limits are the fields of `beamline.monitor.references.ReferenceLimits`.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Literal, get_type_hints

from beamline.config.section import Section, section_of
from beamline.monitor.references import ReferenceLimits


class ReferencesBase(Section):
    """The keys that are not limits."""

    on_fault: Literal["stop", "log"] = "stop"
    """Darks or flats with a fault stop the scan before its first projection, or the fault is logged."""


if TYPE_CHECKING:
    ReferencesSection = ReferencesBase
else:
    _TYPES = get_type_hints(ReferenceLimits, include_extras=True)
    _KEYS: dict[str, Any] = {limit.name: (_TYPES[limit.name], limit.default) for limit in fields(ReferenceLimits)}
    ReferencesSection = section_of("ReferencesSection", ReferencesBase, _KEYS, "Section `references`.")


def reference_limits(section: ReferencesBase) -> ReferenceLimits:
    """The limits that the configuration gives."""
    return ReferenceLimits(**{limit.name: getattr(section, limit.name) for limit in fields(ReferenceLimits)})
