"""The report: one self-contained HTML page that says what was scanned, what came out and how to do it again."""

from __future__ import annotations

import base64
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path

from beamline.core.files import whole_file
from beamline.core.version import version

Table = Mapping[str, str]


@dataclass(frozen=True)
class Picture:
    """A PNG and what it shows. `title` is a short heading, `caption` a sentence that also serves as its alt text."""

    title: str
    caption: str
    png: bytes


@dataclass(frozen=True)
class Report:
    """What goes on the page.

    Attributes:
        title: of the page.
        summary: one or two sentences, the result first.
        scan: facts of the scan, by name.
        settings: what the reconstruction was made with, by name.
        metrics: by method, then by name of the metric (see METRICS); a method may lack some.
        frames: frames there are of those asked for, e.g. "90/90".
        flags: what the monitor or the reconstruction warned of, in words.
        pictures: in order.
        command: the exact command that repeats it.
        footnotes: what a reader must know to read the metrics.
    """

    title: str
    summary: str
    scan: Table
    settings: Table
    metrics: Mapping[str, Mapping[str, float]]
    frames: str
    flags: Sequence[str]
    pictures: Sequence[Picture]
    command: str
    footnotes: Sequence[str] = field(default_factory=tuple)


@dataclass(frozen=True)
class Metric:
    """How a metric is shown."""

    label: str
    unit: str
    digits: int
    better: str


METRICS = {
    "psnr": Metric("PSNR", "dB", 2, "higher"),
    "ssim3d": Metric("SSIM 3D", "", 4, "higher"),
    "nrmse": Metric("NRMSE", "", 4, "lower"),
    "snr": Metric("SNR", "dB", 2, "higher"),
    "cnr": Metric("CNR", "dB", 2, "higher"),
    "residual": Metric("Data residual, views used", "", 4, "lower"),
    "residual_held_out": Metric("Data residual, views held out", "", 4, "lower"),
    "seconds": Metric("Time", "s", 1, "lower"),
}


def formatted(name: str, value: float) -> str:
    """A metric's value as people read it, with its unit; a decibel of nothing is not a number."""
    metric = METRICS[name]
    if not math.isfinite(value):
        return "undefined"
    return f"{value:.{metric.digits}f} {metric.unit}".rstrip()


def write_report(path: Path, report: Report, *, replace: bool = False) -> None:
    """Write the page to `path`; whole or not at all.

    Raises:
        DataError: if `path` exists and `replace` is not set.
    """
    with whole_file(path, replace=replace) as partial:
        partial.write_text(to_html(report), encoding="utf-8")


def to_html(report: Report) -> str:
    """The page as HTML5; it requests nothing from anywhere."""
    sections = [
        f"<h1>{escape(report.title)}</h1>\n<p class='summary'>{escape(report.summary)}</p>",
        _flags(report),
        "<h2>Metrics</h2>\n" + _metrics(report.metrics) + "".join(f"<p>{escape(n)}</p>\n" for n in report.footnotes),
        *(picture_html(picture) for picture in report.pictures),
        "<h2>Scan</h2>\n" + table_html({**report.scan, "frames": report.frames}),
        "<h2>Settings</h2>\n" + table_html(report.settings),
        f"<h2>To repeat</h2>\n<pre><code>{escape(report.command)}</code></pre>",
    ]
    return page(report.title, sections)


def page(title: str, sections: Sequence[str]) -> str:
    """A page in the look of all reports; `sections` are HTML."""
    footer = f"<footer>Made by splatline {escape(version())}.</footer>"
    return _PAGE.format(title=escape(title), css=_CSS, body="\n".join((*sections, footer)))


def _flags(report: Report) -> str:
    if not report.flags:
        return f"<p class='fine'>No flags. Frames: {escape(report.frames)}.</p>"
    items = "\n".join(f"<li>{escape(flag)}</li>" for flag in report.flags)
    count = f"{len(report.flags)} flag{'s' if len(report.flags) > 1 else ''}. Frames: {escape(report.frames)}."
    return f"<div class='flags'><p>{count}</p>\n<ul>{items}</ul></div>"


def _metrics(metrics: Mapping[str, Mapping[str, float]]) -> str:
    head = "".join(f"<th scope='col'>{escape(method)}</th>" for method in metrics)
    rows = []
    for name, metric in METRICS.items():
        if not any(name in values for values in metrics.values()):
            continue
        cells = "".join(f"<td>{formatted(name, v[name]) if name in v else '–'}</td>" for v in metrics.values())
        rows.append(f"<tr><th scope='row'>{metric.label} <small>({metric.better} is better)</small></th>{cells}</tr>")
    return f"<table class='metrics'><thead><tr><td></td>{head}</tr></thead>\n<tbody>{''.join(rows)}</tbody></table>\n"


def table_html(values: Table) -> str:
    """Names and values in two columns."""
    rows = "".join(f"<tr><th scope='row'>{escape(k)}</th><td>{escape(v)}</td></tr>" for k, v in values.items())
    return f"<table><tbody>{rows}</tbody></table>"


def picture_html(picture: Picture) -> str:
    """A picture within the page, under its heading."""
    data = base64.b64encode(picture.png).decode("ascii")
    return (
        f"<h2>{escape(picture.title)}</h2>\n<figure><img alt='{escape(picture.caption)}' "
        f"src='data:image/png;base64,{data}'>\n<figcaption>{escape(picture.caption)}</figcaption></figure>"
    )


_CSS = """
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1b1f24; background: #fff; max-width: 62rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.6rem; margin-bottom: .3rem; }
h2 { font-size: 1.15rem; margin: 2rem 0 .5rem; border-bottom: 1px solid #d0d7de; padding-bottom: .2rem; }
.summary { font-size: 1.05rem; margin-top: 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: .2rem 1.2rem .2rem 0; border-bottom: 1px solid #eaeef2; vertical-align: top;
  overflow-wrap: anywhere; font-weight: normal; }
tbody th { color: #57606a; }
thead th { font-weight: 600; }
.metrics td, .metrics thead th { text-align: right; padding-left: 1.2rem; }
small { color: #6e7781; }
figure { margin: 0; }
img { max-width: 100%; height: auto; }
figcaption { color: #57606a; font-size: .9rem; }
.flags { background: #fff8e1; border-left: 4px solid #d4a72c; padding: .3rem 1rem; }
.fine { background: #eef8f0; border-left: 4px solid #2da44e; padding: .3rem 1rem; }
pre { background: #f6f8fa; padding: .7rem 1rem; overflow-x: auto; }
footer { margin-top: 2rem; color: #6e7781; font-size: .85rem; }
"""

_PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{css}</style>
</head>
<body>
{body}
</body>
</html>
"""
