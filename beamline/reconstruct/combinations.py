"""Combinations: the options of a reconstruction that exclude each other, and why. The command line, recipes, the Python
interface and the plan of a reconstruction all use this table. The help of a command imports this module, so the module
imports nothing that the help does not need.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from types import MappingProxyType
from typing import NamedTuple

SLABS_RESUMED = "resume of slabs"
"""Name for `--resume` with a partial volume, because the rules for a partial volume differ from those for a checkpoint.
"""

_FINISHED = {"follow": "it needs a finished scan"}
_PLANNED = {"quality": "--quality already sets it"}
_BY_SECONDS = {"follow": "it needs a finished scan; use --seconds"}
_WITH_SLABS = {"follow": "a running scan cannot be reconstructed in slabs, because everything must stay in memory"}

EXCLUDED: Mapping[str, Mapping[str, str]] = MappingProxyType(
    {
        "steps": {"seconds": "give one of them", **_PLANNED},
        "gaussians": _PLANNED,
        "finish": {**_PLANNED, **_FINISHED},
        "seconds": _PLANNED,
        "budget": {"quality": "give one of them", **_BY_SECONDS},
        "quality": _BY_SECONDS,
        **dict.fromkeys(("start", "device", "early-stop", "checkpoint", "resume", "allow-negative"), _FINISHED),
        "reference": {
            "volumes": "a reference can be used only for a single volume",
            "uncertainty": "error bars are not calibrated for it",
            "roi": "the motion of the sample must be estimated in the whole field of view",
        },
        "volumes": {  # volumes in time, or volumes of materials
            **_FINISHED,
            "roi": "a box can be cut only from a single volume",
            "truth": "a ground truth can be compared only with a single volume",
            "uncertainty": "error bars are computed only for a single volume",
            **dict.fromkeys(("cluster", SLABS_RESUMED), "several volumes cannot be reconstructed in slabs"),
        },
        "uncertainty": dict.fromkeys(
            ("follow", "budget", "seconds"), "error bars need the complete scan, and time for two further fits"
        ),
        "follow": {SLABS_RESUMED: "slabs can be resumed only for a finished scan"},
        **dict.fromkeys(("memory", "cluster"), _WITH_SLABS),
        "roi": {**_FINISHED, "truth": "a ground truth can be compared only with the whole volume"},
        "dry-run": {
            "follow": "the time of a running scan is not known",
            "budget": "it prints the time of every method",
        },
    }
)
"""For each option the options that cannot be combined with it, each with the reason."""


class Contradiction(NamedTuple):
    """Two options that exclude each other."""

    name: str
    other: str
    why: str


def contradiction(options: Collection[str]) -> Contradiction | None:
    """The first two of the given options that exclude each other, in the order of the table; None: there are none."""
    pairs = (Contradiction(name, *each) for name, others in EXCLUDED.items() for each in others.items())
    return next((pair for pair in pairs if pair.name in options and pair.other in options), None)
