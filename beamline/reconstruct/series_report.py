"""The page of volumes in time: what was fitted, and slices of all times side by side."""

from __future__ import annotations

import numpy as np

from beamline.reconstruct.outcome import ReportContext
from beamline.report.html import Picture, Report
from beamline.report.slice_sheet import SliceSheet
from beamline.storage.recon_record import ReconRecord

FACTORS = "factors of their mean, smooth within matter"
_SHOWN, _UPRIGHT = 12, 8  # times at most; slices from which on upright cuts are drawn, too


def series_page(record: ReconRecord, context: ReportContext, n_views: int, chosen: str) -> Report:
    """The report on a volume series; `chosen` says how it was decided whether matter moves."""
    assert record.series is not None
    seconds, volumes = record.series.seconds, record.series.data
    n, depth = volumes.shape[:2]
    some = np.unique(np.linspace(0, n - 1, min(n, _SHOWN)).round().astype(int))
    pictures = []
    for title, turned in (("Slices of each time", False), ("Upright slices of each time", True)):
        if turned and depth < _UPRIGHT:
            continue
        sheet = SliceSheet("z" if turned else "y")
        for k in some:
            sheet.add(f"{seconds[k]:.4g} s", volumes[k].swapaxes(0, 1) if turned else volumes[k])
        caption = f"{len(some)} of {n} times in one grey window: what differs has changed or moved."
        pictures.append(Picture(title, caption, sheet.png(sheet.labels())))
    moves = "motion was learnt" if record.parameters["moves"] else "nothing moves"
    moves += f"; densities are {FACTORS}" if "smooth" in record.parameters else ""
    shape = " × ".join(map(str, volumes.shape[1:]))
    said = {k: str(v) for k, v in record.parameters.items() if not isinstance(v, np.ndarray) and k != "command"}
    return Report(
        title=f"{context.facts.sample or context.facts.name}: {n} volumes in time",
        summary=f"{n} volumes in time of {shape} voxels, {seconds[0]:.4g} to {seconds[-1]:.4g} s, from one fit of "
        f"{n_views} views; {moves}{'; ' * bool(chosen)}{chosen}.",
        scan=context.facts.table,
        settings=said,
        metrics={"one fit": {**record.metrics, "elapsed": context.elapsed}},
        frames=context.facts.frames,
        flags=[*context.scan_flags, *context.facts.remarks, *context.warnings],
        pictures=pictures,
        command=context.command,
        recipe=context.recipe,
        footnotes=["Data residual: what the volumes, each view at its time, leave of all views. It falls with noise."],
    )
