"""Choices and figures that options name. They load without computing modules, so that help is quick."""

from __future__ import annotations

import re
from typing import Literal

from recon.base.kernel import Kernel

AUTO = "auto"  # Name of the choice among methods, `recon.Auto`

Filter = Literal["ram-lak", "shepp-logan", "hann"]
Loss = Literal["l1", "l2", "poisson"]
Noise = Literal["auto", "log", "counts"]
Quality = Literal["preview", "standard", "best"]
Rings = Literal["none", "auto", "sort", "vo"]
FlatFields = Literal["groups", "dynamic"]
Start = Literal["fbp", "tv", "published"]

KERNEL = Kernel.COMPACT  # Shape of a fit's Gaussians

FEW_PHOTONS = 100
"""Photons in a pixel of the open beam; with fewer, counts are better than logarithms."""

SPOT_ERRORS = 8.0
"""Standard deviations by which a bright spot is brighter, by default; noise exceeds them once in 10¹⁵ pixels."""


def refuse_unknown_device(device: str) -> None:
    """Raises ValueError for a device that is neither "cpu" nor a CUDA device."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise ValueError(
            f"device {device!r} was asked for; methods compute on 'cpu' or on 'cuda', the current CUDA device. Name "
            f"one of these. CUDA_VISIBLE_DEVICES, set before Python starts, chooses the current CUDA device"
        )
