"""Figures of merit as people read them: label, unit, digits, and which direction is better if any is."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Metric:
    """How a figure of merit is shown. short: the heading of its column in a table of trials; empty: it has none."""

    label: str
    unit: str
    digits: int
    direction: str
    short: str = ""


METRICS = {
    "psnr": Metric("PSNR", "dB", 2, "higher is better", "PSNR"),
    "ssim3d": Metric("SSIM 3D", "", 4, "higher is better", "SSIM"),
    "psnr_all": Metric("PSNR against the volume of all views by the same method", "dB", 2, "", "PSNR all"),
    "ssim_all": Metric("SSIM 3D against the volume of all views by the same method", "", 4, "", "SSIM all"),
    "ssim_slices": Metric("SSIM whole slices", "", 4, "higher is better"),
    "nrmse": Metric("NRMSE", "", 4, "lower is better"),
    "snr": Metric("SNR", "dB", 2, "smoother has more", "SNR"),
    "cnr": Metric("CNR", "dB", 2, "smoother has more", "CNR"),
    "residual": Metric("Data residual, views used", "", 4, "lower is better"),
    "residual_held_out": Metric("Data residual, views held out", "", 4, "lower is better", "held out"),
    "unexplained": Metric("Matter that leaves structure", "", 4, "lower is better"),
    "stray": Metric("Mass where views show nothing", "", 4, "lower is better"),
    "air": Metric("Level of air, in noise of FBP", "", 2, "nearer to 0 is better"),
    "seconds": Metric("Time of reconstruction", "s", 1, "lower is better"),
    "elapsed": Metric("Time of the whole command", "s", 1, "lower is better"),
}


def formatted(name: str, value: float) -> str:
    """The value of the metric `name` with its unit; "undefined" if it is not finite, as the dB of a zero ratio is."""
    metric = METRICS[name]
    if not math.isfinite(value):
        return "undefined"
    return f"{value:.{metric.digits}f} {metric.unit}".rstrip()
