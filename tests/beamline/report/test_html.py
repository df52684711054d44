"""The report: valid, self-contained, escaped, written completely or not at all."""

import base64
import re
from pathlib import Path

import pytest

from beamline.core.errors import DataError
from beamline.report.html import Picture, Report, to_html, write_report
from tests.beamline.html_page import parsed_page


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


def test_what_was_done_is_listed_also_where_nothing_is_wrong() -> None:
    text = "".join(parsed_page(to_html(_report(done=["Phase: a filter over <2> pixels."]))).text)
    assert "No remarks" not in text and "No warnings" in text
    assert "Phase: a filter over <2> pixels." in text


def test_report_is_whole_and_never_overwrites(tmp_path: Path) -> None:
    path = tmp_path / "report.html"
    write_report(path, _report())
    assert path.read_text(encoding="utf-8") == to_html(_report())
    with pytest.raises(DataError, match="never overwritten"):
        write_report(path, _report(title="other"))
    write_report(path, _report(title="other"), replace=True)
    assert "other" in path.read_text(encoding="utf-8")
    assert list(tmp_path.iterdir()) == [path]
