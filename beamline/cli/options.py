"""Arguments and options that several commands share: numbers, a configuration with overrides, JSON output."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import click


class FiniteRange(click.FloatRange):
    """A range of finite numbers; click's own range accepts NaN and infinities."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number


POSITIVE = FiniteRange(min=0, min_open=True)
NOT_NEGATIVE = FiniteRange(min=0)
SEED = click.IntRange(min=0)

config_argument = click.argument("file", metavar="CONFIG", type=click.Path(path_type=Path))
set_option = click.option(
    "--set",
    "overrides",
    multiple=True,
    metavar="KEY=VALUE",
    help="Override a value of the configuration, such as scan.period_s=0.2. May be repeated.",
)
json_option = click.option("--json", "as_json", is_flag=True, help="Print one JSON event per line to stdout.")
