"""Figures of merit for people: label, unit, number of digits, and the direction that is better."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """How a figure of merit is shown. short: heading of its column in a table of trials; empty if it has no column."""

    label: str
    unit: str
    digits: int
    direction: str
    short: str = ""


METRICS = {
    "psnr": Metric("PSNR", "dB", 2, "higher is better", "PSNR"),
    "ssim3d": Metric("SSIM 3D", "", 4, "higher is better", "SSIM"),
    "psnr_all": Metric("PSNR against the volume of all projections by the same method", "dB", 2, "", "PSNR all"),
    "ssim_all": Metric("SSIM 3D against the volume of all projections by the same method", "", 4, "", "SSIM all"),
    "ssim_slices": Metric("SSIM whole slices", "", 4, "higher is better"),
    "nrmse": Metric("NRMSE", "", 4, "lower is better"),
    "snr": Metric("SNR", "dB", 2, "smoother has more", "SNR"),
    "cnr": Metric("CNR", "dB", 2, "smoother has more", "CNR"),
    "residual": Metric("Residual of the projections used", "", 4, "lower is better"),
    "residual_held_out": Metric("Residual of the held-out projections", "", 4, "lower is better", "held out"),
    "unexplained": Metric("Unexplained structure in the residual", "", 4, "lower is better"),
    "stray": Metric("Mass in empty regions", "", 4, "lower is better"),
    "air": Metric("Air level, in units of the FBP noise", "", 2, "nearer to 0 is better"),
    "seconds": Metric("Time of reconstruction", "s", 1, "lower is better"),
    "elapsed": Metric("Total time, without loading the program", "s", 1, "lower is better"),
}


def formatted(name: str, value: float) -> str:
    """The value of the metric `name` with its unit; "undefined" if it is not finite, for example dB of a zero ratio."""
    metric = METRICS[name]
    if not math.isfinite(value):
        return "undefined"
    return f"{value:.{metric.digits}f} {metric.unit}".rstrip()
