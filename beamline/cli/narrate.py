"""Narration: a reconstruction's events for people; progress to stderr, results to stdout."""

from __future__ import annotations

from collections.abc import Mapping
from types import TracebackType
from typing import Any, Self

import click
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from beamline.events import Event
from beamline.report import METRICS, formatted


class Narrator:
    """A sink for people. Use as a context manager, so that the bar goes before an error is printed."""

    def __init__(self) -> None:
        console = Console(stderr=True)
        self._bar = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            TextColumn("{task.fields[note]}"),
            TimeElapsedColumn(),
            TimeRemainingColumn(),
            console=console,
            disable=not console.is_terminal,
            transient=True,
        )
        self._task: TaskID | None = None

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._bar.stop()

    def __call__(self, event: Event) -> None:
        data = event.data
        if event.event == "progress":
            self._progress(data)
        elif event.event == "recon_started":
            self._say(f"{data['method']}: {data['n_views']} views, rotation axis at column {data['axis_col']:.2f}")
        elif event.event == "state":
            self._say(str(data["message"]))
        elif event.event == "warning":
            self._say(f"Warning: {data['message']}")
        elif event.event == "done":
            self._bar.stop()
            click.echo(results(data))

    def _say(self, text: str) -> None:
        if self._bar.disable:
            click.echo(text, err=True)
        else:
            self._bar.console.print(text, markup=False, highlight=False)

    def _progress(self, data: Mapping[str, Any]) -> None:
        if self._task is None:
            self._task = self._bar.add_task(str(data["stage"]), note="", total=None)
        note = f"step {data['step']}, {data['n_views']} views, {data['n_gaussians']} Gaussians"
        note += f", residual {data['residual']:.4f}"
        self._bar.update(self._task, completed=data["step"], total=data["steps"] or None, note=note)


def results(data: Mapping[str, Any]) -> str:
    """What came out, as lines of text: where it is, then the metrics by method."""
    lines = [f"{'output':<10}{data['output']}"]
    if data.get("report"):
        lines.append(f"{'report':<10}{data['report']}")
    lines.append(f"{'volume':<10}{' x '.join(str(n) for n in data['shape'])} in {data['units']}")
    lines.append(f"{'axis_col':<10}{data['axis_col']:.2f}")
    columns = {str(data["method"]): data}
    if "fbp" in data:
        columns["fbp"] = data["fbp"]
    lines.append("")
    lines.append(f"{'':<30}" + "".join(f"{name:>14}" for name in columns))
    for name, metric in METRICS.items():
        if any(name in values for values in columns.values()):
            cells = (formatted(name, values[name]) if name in values else "-" for values in columns.values())
            lines.append(f"{metric.label:<30}" + "".join(f"{cell:>14}" for cell in cells))
    return "\n".join(lines)
