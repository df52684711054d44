"""Sections `monitor` and `references` of the configuration: limits, and the effects of alarms and faults on a scan.

The keys of the limits are the fields of the checks in the registry, and of `ReferenceLimits`. So a new check in the
registry can be configured without a change of this module.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

from beamline.config.section import Section, section_of
from beamline.monitor.check import Check, Policy
from beamline.monitor.checks import BY_NAME, CHECKS
from beamline.monitor.references import ReferenceLimits
from recon.base.registry import unknown
from recon.base.setting import Setting, setting


def _no_checks(retake: bool | tuple[str, ...]) -> str:
    """The fault of a list of names of checks; "" if all names are known."""
    wrong = () if isinstance(retake, bool) else [name for name in retake if name not in BY_NAME]
    return f"{unknown('check', wrong[0], BY_NAME)}; expected true, false, or a list of names of checks" if wrong else ""


class MonitorBase(Section):
    """The keys that do not depend on the checks."""

    act_after: int = setting(
        10,
        "Number of consecutive frames with an alarm after which the policy of the check pauses or stops the scan.",
        ge=1,
    )
    retake: Annotated[bool | tuple[str, ...], Setting(problem=_no_checks)] = setting(
        False,
        "true: after the last projection, projections with an alarm or without a frame are taken again, once. A "
        "list of checks: projections with a warning of these checks are also taken again.",
    )
    retake_share: float = setting(0.25, "Largest fraction of the projections that the scan takes again.", gt=0, le=1)

    @property
    def retaken_warnings(self) -> frozenset[str]:
        """The checks whose warnings make the scan take a projection again."""
        return frozenset() if isinstance(self.retake, bool) else frozenset(self.retake)


def _keys(limits: type[Any]) -> dict[str, Any]:
    types = get_type_hints(limits, include_extras=True)
    return {limit.name: (types[limit.name], limit) for limit in fields(limits)}


def _limits_of(check: Check) -> Any:
    """The section with the limits of a check, and its default, in the form of a key for `section_of`."""
    section = section_of(f"{type(check).__name__}Limits", Section, _keys(type(check)), f"Flag: {check.meaning}.")
    return section, section()


def _policies() -> Any:
    """The section with the policy of each check, and its default, in the form of a key for `section_of`."""
    keys: dict[str, Any] = {check.name: (Policy, check.policy) for check in CHECKS}
    section = section_of("Policies", Section, keys, "The effect of an alarm of each check on a scan.")
    return section, section()


if TYPE_CHECKING:
    MonitorSection = MonitorBase
else:
    _LIMITS = {check.name: _limits_of(check) for check in CHECKS if fields(check)}
    MonitorSection = section_of("MonitorSection", MonitorBase, {"policy": _policies(), **_LIMITS}, "Section `monitor`.")


def configured_checks(monitor: MonitorBase) -> tuple[Check, ...]:
    """All checks, with the limits of the configuration."""
    return tuple(replace(check, **dict(getattr(monitor, check.name, ()))) for check in CHECKS)


def policies(monitor: MonitorBase) -> Mapping[str, Policy]:
    """The policy for alarms, by the name of the check."""
    section: Section = monitor.policy  # type: ignore[attr-defined]  # made above, from the registry
    return {name: Policy(policy) for name, policy in section}


class ReferencesBase(Section):
    """The keys that are not limits."""

    on_fault: Literal["stop", "log"] = setting(
        "stop",
        "What the scan does if darks or flats have a fault: it stops before the first projection, or it only logs the "
        "fault.",
    )


if TYPE_CHECKING:
    ReferencesSection = ReferencesBase
else:
    ReferencesSection = section_of("ReferencesSection", ReferencesBase, _keys(ReferenceLimits), "Section `references`.")


def reference_limits(section: ReferencesBase) -> ReferenceLimits:
    """The limits for darks and flats from the configuration."""
    return ReferenceLimits(**{limit.name: getattr(section, limit.name) for limit in fields(ReferenceLimits)})
