"""`beamline tune`, `align`: a few frames before a scan say which exposure to take, and where the axis is."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import click

from beamline.cli.options import config_argument, json_events, json_option, set_option
from beamline.cli.terminal import Terminal
from beamline.core.errors import QualityError
from beamline.core.events import Done, Sink
from beamline.core.sinks import Announcer
from beamline.core.stop import StopRequest, stop_signals

if TYPE_CHECKING:
    from beamline.config.load import Config
    from beamline.features.tuning.align import Alignment
    from beamline.features.tuning.tune import Tuning
    from beamline.instrument.connect import ConnectedDevices


Found = TypeVar("Found", bound="Tuning | Alignment")


@click.command()
@config_argument
@click.option("--angle", type=float, help="Angle of the view, degrees. Default: the first one of the scan.")
@set_option
@json_option
def tune(file: Path, angle: float | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Take darks, flats and a view, and report counts, saturation, transmission, noise and the exposure to take.

    The shutter opens, the sample goes out and back, the stage turns to the view's angle and back. Two darks and two
    flats tell noise from structure. Flats and view are also taken at an eighth and a 64th of the exposure, in case
    they saturate. Nothing is written.

    Exit code: 0 done, 2 wrong configuration, 3 a device failed, 4 stopped, 6 the darks or flats would stop a scan.
    """
    from beamline.features.tuning.tune import tune as tune_exposure

    result = evaluated(file, overrides, as_json, tune_exposure, angle)
    if result.faults:
        if math.isnan(result.advised):
            raise QualityError("These references would stop a scan, and no exposure mends that: look at the FAULT.")
        raise QualityError(f"These references would stop a scan; {result.advised:.4g} s is the exposure to take.")


def evaluated(
    file: Path, overrides: Sequence[str], as_json: bool,
    evaluate: Callable[[Config, ConnectedDevices, StopRequest, Sink, float | None], Found], angle: float | None,
) -> Found:  # fmt: skip
    """What `evaluate` finds in views from `angle`, degrees, printed as lines or JSON."""
    from beamline.config.load import load
    from beamline.instrument.connect import ask_operator, connect

    with json_events(as_json) as json_sink:
        config = load(file, overrides)
        stop = StopRequest()
        with (
            stop_signals(stop),
            Terminal(sys.stderr) as terminal,
            connect(config, ask=lambda request: terminal.ask(request, ask_operator)) as instrument,
            Announcer([terminal, json_sink], instrument.clock) as emit,
        ):
            result = evaluate(config, instrument, stop, emit, None if angle is None else math.radians(angle))
            now = instrument.clock.now()
        json_sink(Done(result, time=now))
    if not as_json:
        click.echo("\n".join(result.lines()))
    return result


@click.command()
@config_argument
@click.option("--angle", type=float, help="Angle of the first view, degrees. Default: the first one of the scan.")
@set_option
@json_option
def align(file: Path, angle: float | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Take a pair of views half a turn apart, and report axis, tilt and sharpness, with the correction of each.

    The shutter opens, the sample goes out and back, the stage turns to both angles and back. Mend what is said, and
    call it again. Nothing is written.

    Exit code: 0 done, 2 wrong configuration, 3 a device failed, 4 stopped, 6 the views show no axis.
    """
    from beamline.features.tuning.align import align as align_views

    evaluated(file, overrides, as_json, align_views, angle)
