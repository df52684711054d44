"""The logbook page: a sheet of A4 on which nothing lies over another, however much there is to say."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.transforms import Bbox

from beamline.core.errors import DataError
from beamline.report.html import Report
from beamline.report.logbook import as_pdf, logbook, write_logbook
from recon.base.volume import Grid, Volume

NOW = 1.79e9


def _report(words: int, flags: int) -> Report:
    said = "words on what was done and seen " * words
    return Report(
        title=f"Sample {'with a long name ' * words}: FBP",
        summary=f"A volume. {said * 2}",
        scan={f"fact {i}": "value " * (1 + i % 9 * words) for i in range(4 * words)},
        settings={"method": "fbp", "axis_col": "85.8448", "tilt": said, "noise": said, "seed": "0"},
        metrics={name: {"residual": 0.04, "snr": 24.0, "seconds": 3.0} for name in ("FBP", "R²-Gaussian")[:words]},
        frames="90/90",
        flags=[f"Warning {i}: $x_1$ and {said}" for i in range(flags)],
        pictures=[],
        command=f"beamline recon {'/folder_name' * 8 * words}/scan.h5 --method fbp",
    )


def _volume(shape: tuple[int, int, int]) -> Volume:
    return Volume(np.random.default_rng(1).random(shape).astype(np.float32), Grid(shape, 0.01))


def _boxes(figure: Figure) -> list[tuple[str, Bbox]]:
    """Of all texts and slices, in inches."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    boxes = [(text.get_text(), text.get_window_extent(canvas.get_renderer())) for text in figure.texts]
    boxes += [(f"slice {i}", axes.get_window_extent()) for i, axes in enumerate(figure.axes)]
    return [(name, Bbox(box.get_points() / figure.dpi)) for name, box in boxes if name]


@pytest.mark.parametrize(
    ("words", "flags", "shape"),
    [(1, 0, (20, 40, 40)), (4, 30, (20, 40, 40)), (4, 5, (400, 60, 60)), (1, 2, (2, 300, 300)), (2, 1, (1, 5, 5))],
)
def test_nothing_lies_over_another(words: int, flags: int, shape: tuple[int, int, int]) -> None:
    page = logbook(_report(words, flags), _volume(shape), "mm", NOW)
    assert tuple(page.get_size_inches()) == (8.27, 11.69) and len(page.axes) == 6
    boxes = _boxes(page)
    for name, box in boxes:
        assert box.x0 >= 0.5 and box.x1 <= 8.27 - 0.4 and box.y0 >= 0.5 and box.y1 <= 11.69 - 0.4, name
    for (one, a), (other, b) in itertools.combinations(boxes, 2):
        wide, high = min(a.x1, b.x1) - max(a.x0, b.x0), min(a.y1, b.y1) - max(a.y0, b.y0)
        assert wide < 0.02 or high < 0.02, (one, other)  # a fiftieth of an inch: less than lines are apart


def test_the_page_says_what_the_report_says() -> None:
    texts = [name for name, _ in _boxes(logbook(_report(1, 2), _volume((20, 40, 40)), "mm", NOW))]
    for said in (
        "2026-09-21",
        "fact 3",
        "fbp",
        "0.0400",
        "lower is better",
        "Warning 1: $x_1$",
        "low contrast: ",
        "90/90",
    ):
        assert any(said in text for text in texts), said
    crowded = [name for name, _ in _boxes(logbook(_report(4, 40), _volume((20, 40, 40)), "mm", NOW))]
    assert any(text.startswith("... and more, ") for text in crowded)
    assert any(text.startswith("... and ") and text.endswith(" more: see the report") for text in crowded)
    quiet = [name for name, _ in _boxes(logbook(_report(1, 0), _volume((20, 40, 40)), "mm", NOW))]
    assert "• None." in quiet


def test_the_file_is_one_page_and_the_same_again(tmp_path: Path) -> None:
    report, volume = _report(1, 1), _volume((3, 1000, 1000))
    write_logbook(tmp_path / "a.pdf", report, volume, "mm", NOW)
    written = (tmp_path / "a.pdf").read_bytes()
    assert written.startswith(b"%PDF-1.4") and b"/Count 1 " in written
    assert b"/MediaBox [ 0 0 595.44 841.68 ]" in written
    assert len(written) < 3e6  # slices have no more pixels than a page shows
    assert written == as_pdf(logbook(report, volume, "mm", NOW))
    with pytest.raises(DataError, match="exists"):
        write_logbook(tmp_path / "a.pdf", report, volume, "mm", NOW)
    assert (tmp_path / "a.pdf").read_bytes() == written
