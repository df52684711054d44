"""Names and defaults that command-line options show. This module imports no numerical code, so that help appears
fast."""

from __future__ import annotations

import re
from typing import Literal

from recon.base.kernel import Kernel

AUTO = "auto"  # name of the automatic choice of a method, `recon.Auto`

Filter = Literal["ram-lak", "shepp-logan", "hann"]
Loss = Literal["l1", "l2", "poisson"]
Noise = Literal["auto", "log", "counts"]
Quality = Literal["preview", "standard", "best"]
Rings = Literal["none", "auto", "sort", "vo"]
FlatFields = Literal["groups", "dynamic"]
Start = Literal["fbp", "tv", "published"]

KERNEL = Kernel.COMPACT  # default radial profile of the Gaussians of a fit

FEW_PHOTONS = 100
"""Photons per pixel in the open beam. Below this number, a fit to the counts is better than a fit to their
logarithm."""

SPOT_ERRORS = 8.0
"""Default threshold for zingers, in standard deviations above the neighbouring pixels. Noise alone exceeds this
threshold in one of 10¹⁵ pixels."""


def refuse_unknown_device(device: str) -> None:
    """Raises ValueError for a device that is neither "cpu" nor a CUDA device."""
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise ValueError(
            f"device must be 'cpu' or 'cuda', got {device!r}. 'cuda' is the current CUDA device. To choose another "
            "CUDA device, set CUDA_VISIBLE_DEVICES before Python starts"
        )
