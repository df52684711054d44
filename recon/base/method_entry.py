"""MethodEntry: the line of a method in the registry of methods."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Lengths:
    """Numbers of iterations or steps that a comparison tries of a method.

    Attributes:
        setting: "iterations" or "steps".
        quick, full: of a short and of a long comparison. The first one is the baseline, about which others vary.
        chosen: the data choose a length by default, which is the baseline.
    """

    setting: Literal["iterations", "steps"]
    quick: tuple[int, ...]
    full: tuple[int, ...]
    chosen: bool = False


@dataclass(frozen=True)
class MethodEntry:
    """Where the settings class of a method is, and when it is compared with others.

    Attributes:
        module, cls: of its settings class, see `recon.base.method.Method`.
        streams: it has `stream`, so that its volume can grow while views arrive.
        compared: a trade-off tries it if no methods are named; False for methods that take many times as long.
        emission: it is compared where the sample emits, whatever `compared` says.
        several: what its volumes are of, where it makes several.
        lengths: that a trade-off tries; None: the default.
    """

    module: str
    cls: str
    streams: bool = False
    compared: bool = True
    emission: bool = False
    several: Literal["", "times", "materials"] = ""
    lengths: Lengths | None = None
