"""The report: valid, self-contained, escaped; its pictures show what their labels say."""

import base64
import io
import re
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from beamline.core.errors import DataError
from beamline.report import figures
from beamline.report.html import Picture, Report, to_html, write_report
from beamline.report.sheets import reference_sheet
from recon.base.geometry import Geometry
from recon.base.volume import Grid, Volume
from tests.beamline.html_page import parsed_page

pytestmark = pytest.mark.usefixtures("real_pictures")


def _pixels(png: bytes) -> np.ndarray:
    return matplotlib.image.imread(io.BytesIO(png), format="png")


def _report(**changes: object) -> Report:
    values: dict[str, object] = {
        "title": "battery <1>",
        "summary": "R² reached 31 dB & more.",
        "scan": {"sample": "battery"},
        "settings": {"views": "90 of 180"},
        "metrics": {"FBP": {"psnr": 25.123, "seconds": 1.0}, "R²-Gaussian": {"psnr": 31.456, "ssim3d": 0.9}},
        "frames": "110/110",
        "flags": [],
        "pictures": [Picture("Sinogram", 'A "sinogram" isn\'t <much>', b"\x89PNG fake")],
        "command": "beamline recon 'my scan.h5' --axis 85.75",
    }
    return Report(**{**values, **changes})  # type: ignore[arg-type]


def test_page_nests_is_self_contained_and_escapes() -> None:
    page = to_html(_report())
    parsed = parsed_page(page)
    assert page.startswith("<!DOCTYPE html>") and "@media print" in page
    text = "".join(parsed.text)
    for said in ("battery <1>", "31 dB & more", "beamline recon 'my scan.h5' --axis 85.75", "90 of 180", "110/110"):
        assert said in text
    (image,) = [attrs for tag, attrs in parsed.seen if tag == "img"]
    assert image["alt"] == 'A "sinogram" isn\'t <much>'
    assert base64.b64decode((image["src"] or "").split(",")[1]) == b"\x89PNG fake"


def test_the_live_picture_is_a_link_where_there_is_one() -> None:
    def links(report: Report) -> list[str | None]:
        found = [attrs["href"] for tag, attrs in parsed_page(to_html(report)).seen if tag == "a"]
        return [link for link in found if link and not link.startswith("#")]

    assert links(_report()) == []
    assert links(_report(live_picture="a #1.live.png")) == ["a%20%231.live.png"]


def test_metrics_stand_in_their_method_column() -> None:
    page = to_html(_report())
    row = re.search(r'<tr><th scope="row">PSNR.*?</tr>', page)
    assert row is not None
    assert re.findall(r"<td>(.*?)</td>", row[0]) == ["25.12 dB", "31.46 dB"]
    row = re.search(r'<tr><th scope="row">SSIM 3D.*?</tr>', page)
    assert row is not None
    assert re.findall(r"<td>(.*?)</td>", row[0]) == ["–", "0.9000"]
    assert "NRMSE" not in page


def test_remarks_are_counted_and_listed() -> None:
    text = "".join(parsed_page(to_html(_report(flags=["axis <not> confident", "beam low"]))).text)
    assert "2 remarks" in text
    assert "axis <not> confident" in text
    assert "No remarks" in "".join(parsed_page(to_html(_report())).text)


def test_report_is_whole_and_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(path, _report())
    assert path.read_text(encoding="utf-8") == to_html(_report())
    with pytest.raises(DataError, match="never overwritten"):
        write_report(path, _report(title="other"))
    write_report(path, _report(title="other"), replace=True)
    assert "other" in path.read_text(encoding="utf-8")
    assert list(tmp_path.iterdir()) == [path]


def test_grey_window_ignores_nan_and_outliers() -> None:
    values = np.linspace(0.0, 1.0, 10_001)
    values[7] = np.nan
    values[-1] = 1e9
    low, high = figures.grey_window([values[:5000], values[5000:]])
    assert (low, high) == (pytest.approx(0.01, abs=1e-3), pytest.approx(0.995, abs=1e-3))
    assert figures.grey_window([np.full(5, 3.0)]) == (3.0, 4.0)
    assert figures.grey_window([np.full(5, np.nan)]) == (0.0, 1.0)


def _levels(png: bytes) -> set[float]:
    """Grey levels of large areas of a picture."""
    pixels = _pixels(png)[..., :3]
    grey = pixels[(np.ptp(pixels, axis=-1) == 0)][:, 0]
    values, counts = np.unique(np.round(grey, 2), return_counts=True)
    return set(values[counts > 2000].tolist())


def test_slices_share_one_window(rng: np.random.Generator) -> None:
    """Two flat volumes of 0 and 1 beside one of 0.5: with one window they are black, white and mid-grey."""
    grid = Grid((20, 24, 28), 0.5)
    volumes = {f"{v}": Volume(np.full(grid.shape, v, np.float32), grid) for v in (0.0, 0.5, 1.0)}
    levels = _levels(figures.orthogonal_slices(volumes, "mm"))
    assert {0.0, 1.0} <= levels
    assert any(abs(level - 0.5) < 0.02 for level in levels)


def test_slices_meet_where_the_volume_is_bright() -> None:
    """One bright ball off the middle: all three slices show it."""
    grid = Grid((40, 50, 60), 1.0)
    z, y, x = np.meshgrid(*(np.arange(n) for n in grid.shape), indexing="ij")
    ball = ((z - 10) ** 2 + (y - 38) ** 2 + (x - 15) ** 2 < 16).astype(np.float32)
    assert figures.bright_centre(ball) == (10, 38, 15)
    assert figures.bright_centre(np.zeros((4, 6, 8), np.float32)) == (2, 3, 4)


def test_y_and_z_run_downwards_in_slices_and_views(monkeypatch: pytest.MonkeyPatch) -> None:
    """Row 0 is at the top, as image viewers show it, and the numbers beside it agree."""
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "png", lambda figure: drawn.append(figure) or b"")
    data = np.arange(40.0, dtype=np.float32).reshape(4, 10, 1).repeat(10, axis=2)
    figures.projection(data[:, :, 0][None], Geometry.parallel([0.0], (4, 10)), 0, "mm")
    figures.orthogonal_slices({"v": Volume(data, Grid(data.shape, 1.0))}, "mm")
    volume = Volume(data, Grid(data.shape, 1.0))
    figures.differences({"v": volume, "w": volume}, "mm")
    figures.significance(data[0], volume.grid, 0, "mm")
    axes = [axes for figure in drawn for axes in figure.axes if axes.get_xlabel() in ("u (mm)", "x (mm)", "y (mm)")]
    names = [panel.get_ylabel() for panel in axes]
    assert names == ["← z (mm)", "← y (mm)", "← z (mm)", "← z (mm)", "← y (mm)", "← y (mm)"]
    for panel in axes:
        bottom, top = panel.get_ylim()
        assert (panel.images[0].origin, top < bottom) == ("upper", True)


def test_differences_are_from_the_first_in_one_scale_about_zero(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(figures, "png", lambda figure: drawn.append(figure) or b"")
    grid = Grid((3, 8, 9), 1.0)
    volumes = {name: Volume(np.full(grid.shape, v, np.float32), grid) for name, v in (("a", 1), ("b", 3), ("c", 0.5))}
    figures.differences(volumes, "px")
    images = [(axes.get_title(), axes.images[0]) for axes in drawn[0].axes if axes.images]
    assert [title for title, _ in images] == ["b − a", "c − a"]
    for (_, image), value in zip(images, (2.0, -0.5), strict=True):
        np.testing.assert_array_equal(np.asarray(image.get_array()), value)
        assert image.norm.vmin == -image.norm.vmax  # type: ignore[operator]


def test_the_sheet_of_darks_and_flats(rng: np.random.Generator) -> None:
    images = {title: rng.random((20, 30), dtype=np.float32) for title in ("dark", "flats", "last flats / first")}
    assert _pixels(reference_sheet(images, (200, 300))).ndim == 3
    assert _pixels(reference_sheet({"dark": images["dark"][:1]}, (2, 300))).ndim == 3
