"""`beamline export --film`: a film of a volume's slices, or of a scan's views by angle."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beamline.cli.terminal import counting, events_shown
from beamline.core.events import Done, Sink
from beamline.core.files import refuse_existing
from beamline.core.sinks import Warnings
from drivers.base.clock import SystemClock

if TYPE_CHECKING:
    from beamline.features.export.film_file import FilmImages, FilmStyle, WrittenFilm

VIEWS, AXES = "views", "zyx"
SUFFIXES = (".gif", ".mp4")


def export_film(of: str, file: Path, output: Path, style: FilmStyle, dataset: tuple[str | None, int | None],
                as_json: bool) -> None:  # fmt: skip
    """Write the film and print what it shows.

    Args:
        of: "z", "y", "x" or "views".
        dataset: of a volume: which array, and which volume of a series in time.
    """
    from beamline.features.export.film_file import write_film

    clock = SystemClock()
    with events_shown(as_json) as sink:
        refuse_existing(output)
        with _images(of, file, style, dataset, sink) as images:
            made = write_film(output, images, style, counting("images", sink, clock))
        every = images.shown[1] - images.shown[0] if of != VIEWS and len(images.shown) > 1 else 1
        facts = {"output": output, "film": of, "images": made.images, "shape": made.shape, "fps": made.fps}
        sink(Done({**facts, "window": made.window}, time=clock.now()))
    if not as_json:
        click.echo("\n".join(_lines(output, of, made, every)))


@contextmanager
def _images(
    of: str, file: Path, style: FilmStyle, dataset: tuple[str | None, int | None], sink: Sink
) -> Iterator[FilmImages]:
    from beamline.features.export.film_file import slices_along

    if of != VIEWS:
        from beamline.storage.volumes.files import opened_volume

        with opened_volume(file, *dataset) as record:
            yield slices_along(record, AXES.index(of), style.side)
        return
    from beamline.features.export.view_film import views_by_angle
    from beamline.storage.readers.open import SourceOptions

    with SourceOptions(file, frames_per_view=None).open() as source:
        yield views_by_angle(source, style.side, Warnings(sink, SystemClock()))


def _lines(output: Path, of: str, made: WrittenFilm, every: int) -> list[str]:
    shown = "views by angle" if of == VIEWS else f"slices along {of}"
    if every > 1:
        shown += f", one of {every}"
    rows, cols = made.shape
    low, high = made.window
    length = f"{made.images / made.fps:.1f} s, {made.fps:.3g} a second"
    return [
        f"output   {output}",
        f"film     {made.images} {shown}, {cols} x {rows} pixels; {length}",
        f"window   {low:.4g} (black) to {high:.4g} (white)",
    ]
