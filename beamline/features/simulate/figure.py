"""Figure: overview of a simulated scan: a dark, a flat and some views, with frames around labelled anomalies."""

from __future__ import annotations

import numpy as np
from matplotlib.patches import Rectangle

from beamline.report.figures import grey_window, new_figure, png
from drivers.base.frame import FrameKind
from simulators.effects.chain import Anomaly
from simulators.scenes.expose import Scan, expose

COLUMNS, PICTURES = 4, 8
_COLOURS = ("tab:orange", "tab:cyan", "tab:pink", "tab:olive", "tab:green", "tab:red", "tab:purple")
FLATTEST, TALLEST = 0.1, 3.0  # limits of a picture's height over its width; other frames get margins
MOST = 512  # pixels a side that a picture of 2 inches can resolve


def sheet(scan: Scan, marked: tuple[int, ...] = ()) -> bytes:
    """PNG. Its frames are computed again, so that it needs no file.

    Args:
        marked: frames to include, such as those with anomalies.
    """
    numbers = _chosen(scan, marked)
    chosen = [(n, scan.frame(n)) for n in numbers]
    frames = [expose(scan.scene, planned.shot) for _, planned in chosen]
    step = max(1, -(-max(scan.detector.shape) // MOST))
    small = [frame[::step, ::step].astype(np.float32) for frame in frames]
    views = [frame for frame, (_, planned) in zip(small, chosen, strict=True) if planned.kind is FrameKind.PROJECTION]
    low, high = grey_window(views, 0.5, 99.8)
    rows = -(-len(frames) // COLUMNS)
    tall = min(max(scan.detector.shape[0] / scan.detector.shape[1], FLATTEST), TALLEST)
    figure = new_figure((10.5, 0.4 + 2.9 * rows * tall + 0.3 * rows), constrained=False)
    anomalies = [effect.name for effect in scan.scene.chain.effects if isinstance(effect, Anomaly)]
    for place, ((number, planned), frame) in enumerate(zip(chosen, small, strict=True), start=1):
        axes = figure.add_subplot(rows, COLUMNS, place)
        axes.imshow(frame, cmap="gray", vmin=low, vmax=high, interpolation="nearest")
        axes.set_xticks([])
        axes.set_yticks([])
        kind = planned.kind.name.lower()
        angle = f" at {np.degrees(planned.shot.angle):.1f}°" if planned.kind is FrameKind.PROJECTION else ""
        axes.set_title(f"{number}: {kind}{angle}", fontsize=8)
        labels = scan.scene.chain.labels(planned.shot)
        kinds = list(dict.fromkeys(label.kind for label in labels))
        for label in labels:
            row = kinds.index(label.kind)
            top, bottom, left, right = (edge / step for edge in label.region)
            colour = _COLOURS[anomalies.index(label.kind) % len(_COLOURS)]
            corner, size = (left - 0.5, top - 0.5), (right - left, bottom - top)
            axes.add_patch(Rectangle(corner, *size, fill=False, color=colour, lw=1.2))
            axes.text(0.02, 0.97 - 0.07 * row, label.kind, color=colour, fontsize=7, va="top", transform=axes.transAxes)
    figure.suptitle(f"counts {low:.0f} (black) to {high:.0f} (white)", fontsize=8)
    figure.tight_layout()
    return png(figure)


def _chosen(scan: Scan, marked: tuple[int, ...]) -> list[int]:
    """A dark and a flat, if any, marked frames, and views spread over the scan."""
    settings = scan.scene.scan
    first_view = settings.darks + settings.flats
    numbers = [0] if settings.darks else []
    numbers += [settings.darks] if settings.flats else []
    numbers += list(dict.fromkeys(marked))[: PICTURES - len(numbers)]
    spread = np.linspace(first_view, len(scan) - 1, PICTURES - len(numbers)).round().astype(int)
    return sorted({*numbers, *spread.tolist()})
