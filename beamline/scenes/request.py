"""What `beamline simulate` is asked for, how it tells its results, and the table of effects."""

from __future__ import annotations

import inspect
import textwrap
from collections.abc import Iterator
from dataclasses import MISSING, Field, dataclass, fields, replace
from pathlib import Path
from typing import Any

import click

from beamline.cli.options import json_option, set_by
from beamline.core.events import Event, Sink
from drivers.base.clock import Clock
from simulators.effects.catalogue import CATALOGUE, load_effect

_WIDTH, _INDENT = 110, 6  # characters


def effects_text() -> str:
    """Each effect that a scene may name, in the order of physics: what it acts on, what happens, and its parameters
    with their defaults, units and meaning. This imports all of them."""
    lines = []
    for name, row in sorted(CATALOGUE.items(), key=lambda item: item[1].domain):
        lines.append(f"{name}  ({row.domain.words}): {row.summary}")
        for key, default, meaning in parameters(load_effect(name)):
            text = f"{key}{f' = {default}' if default else ', to be given'}: {meaning}"
            lines += textwrap.wrap(text, _WIDTH, initial_indent="    ", subsequent_indent=" " * _INDENT)
    return "\n".join(lines)


def parameters(effect: type[Any]) -> Iterator[tuple[str, str, str]]:
    """Name, default ("" where it must be given) and meaning of each parameter of an effect."""
    meanings = _meanings(effect)
    for field in fields(effect):
        if field.init:
            yield field.name, _default(field), meanings.get(field.name, "")


def _default(field: Field[Any]) -> str:
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if value is MISSING:
        return ""
    if value is None:
        return "null"
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else f"{value:g}" if isinstance(value, float) else str(value)


def _meanings(effect: type[Any]) -> dict[str, str]:
    """The section `Attributes` of a docstring by name; a line may describe several, and go on in the next one."""
    known, meanings, names = {field.name for field in fields(effect)}, dict[str, str](), tuple[str, ...]()
    _, _, section = (inspect.getdoc(effect) or "").partition("\nAttributes:\n")
    for line in map(str.strip, section.splitlines()):
        head, colon, rest = line.partition(": ")
        named = tuple(name.strip() for name in head.split(","))
        if colon and known.issuperset(named):
            names = named
            meanings |= dict.fromkeys(names, rest)
        else:
            meanings |= {name: f"{meanings[name]} {line}".strip() for name in names}
    return meanings


_OVERRIDE_HELP = "Override a value of the scene, such as detector.shape=[2048,2048]. May be repeated."
_VIEWS = click.IntRange(1)
_SEED = click.IntRange(0, 2**63 - 1)
_FILE = click.Path(path_type=Path, dir_okay=False)


def _print_effects(ctx: click.Context, param: click.Parameter, wanted: bool) -> None:
    if wanted:
        click.echo(effects_text())
        ctx.exit()


@dataclass(frozen=True, eq=False)
class SimulateRequest:
    """The arguments of `beamline simulate`."""

    scene: str = set_by(click.argument("scene", metavar="SCENE"))
    explains: bool = set_by(
        click.option(
            "--effects",
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_print_effects,
            help="Print all effects that a scene may name, with their parameters, and end.",
        ),
        "--explain",
        is_flag=True,
        help="Print the steps of computing a frame, in order.",
    )
    views: int | None = set_by(
        "--frames",
        type=_VIEWS,
        metavar="N",
        help="Number of views over the scene's range, at the same speed of the stage. Default: as in the scene.",
    )
    out: Path | None = set_by(
        "-o", "--output", "--out", type=_FILE, help="Write the scan to this HDF5 file and its labels beside it."
    )
    truth: Path | None = set_by(
        "--truth", type=_FILE, help="Write the sample's attenuation and labels to this HDF5 file."
    )
    truth_bin: int | None = set_by(
        "--truth-bin",
        type=click.IntRange(min=1),
        help="Side of a voxel of the truth in pixels: the --bin of the reconstruction to compare. Default: for 256 "
        "voxels.",
    )
    picture: Path | None = set_by(
        "--picture", type=_FILE, help="Write some frames to this PNG file. Default: beside --out."
    )
    seed: int = set_by(
        "--seed", type=_SEED, metavar="N", default=0, show_default=True, help="Seed of all random numbers."
    )
    overrides: tuple[str, ...] = set_by("--set", multiple=True, metavar="KEY=VALUE", help=_OVERRIDE_HELP)
    as_json: bool = set_by(json_option)


class Output:
    """Prints results as lines for people and sends them as events to programs."""

    def __init__(self, sink: Sink, clock: Clock, *, plain: bool) -> None:
        self._sink, self._clock, self._plain = sink, clock, plain

    def __call__(self, what: str, text: str) -> None:
        self.lines(f"{what:<10}{text}")

    def lines(self, text: str) -> None:
        if self._plain:
            click.echo(text)

    def event(self, event: Event) -> None:
        self._sink(replace(event, time=self._clock.now()))
