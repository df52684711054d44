"""HTML pages from the templates in this folder. A page is one file and requests nothing from the network."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import replace as with_fields
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined

from beamline.core.errors import DataError
from beamline.core.files import write_whole
from beamline.core.installed import version
from beamline.report.metrics import METRICS, formatted

FactTable = Mapping[str, str]  # Values for people by name, which the page shows as a table of two columns


@dataclass(frozen=True)
class Picture:
    """A PNG with its description. `title` is a short heading. `caption` is a sentence that is also the alt text."""

    title: str
    caption: str
    png: bytes


@dataclass(frozen=True)
class Report:
    """The content of the page on a reconstruction.

    Attributes:
        summary: one or two sentences, the result first.
        metrics: figures of merit by method, then by name (see METRICS). A method need not have all of them.
        frames: number of frames in the file and number of planned frames, e.g. "90/90".
        flags: remarks of the monitor (also facts) and of the reconstruction; `scan` has the number of flagged frames.
        recipe: the options that also apply to other scans; empty: no options are shown. done: sentences on what was
            found in the projections and what was done with them, although nothing is wrong.
        footnotes: definitions that the metrics need.
        volume: name of the file of the volume, in the folder of the page; empty: the volume was not written.
        live_picture: name of the picture of the growing volume, in the folder of the page; empty: no picture.
    """

    title: str
    summary: str
    scan: FactTable
    settings: FactTable
    metrics: Mapping[str, Mapping[str, float]]
    frames: str
    flags: Sequence[str]
    pictures: Sequence[Picture]
    command: str
    done: Sequence[str] = ()
    footnotes: Sequence[str] = ()
    recipe: str = ""
    volume: str = ""
    live_picture: str = ""


def write_report(path: Path, report: Report, *, replace: bool = False) -> None:
    """Write the page to `path`, completely or not at all.

    Raises: DataError: `path` exists and `replace` is False.
    """
    write_whole(path, to_html(report), replace=replace)


def write_timed(path: Path, report: Report, label: str, elapsed: float) -> None:
    """Write the page of the report again, with the duration of the whole command in the column of a method.

    This duration is known only after everything else is written. If the disk is full, the page is not changed.
    """
    timed = {**report.metrics, label: {**report.metrics[label], "elapsed": elapsed}}
    with suppress(DataError):
        write_report(path, with_fields(report, metrics=timed), replace=True)


def to_html(report: Report) -> str:
    """The report as an HTML5 page. A metric that no method has gets no row."""
    methods = report.metrics.values()
    rows = [
        (metric, [formatted(name, values[name]) if name in values else "–" for values in methods])
        for name, metric in METRICS.items()
        if any(name in values for values in methods)
    ]
    scan = {**report.scan, "frames": report.frames}
    return render("report.html", title=report.title, summary=report.summary, report=report, scan=scan, rows=rows)


def render(template: str, **values: object) -> str:
    """The template of this name, filled in. Values are escaped, and a missing value raises jinja2.UndefinedError."""
    return _templates().get_template(template).render(version=version(), **values)


@cache
def _templates() -> Environment:
    templates = Environment(
        loader=PackageLoader("beamline.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    templates.filters["data_url"] = lambda png: "data:image/png;base64," + base64.b64encode(png).decode("ascii")
    return templates
