"""`beamline tune`, `align`: find the exposure time and the rotation axis from a few frames before a scan."""

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
@click.option("--angle", type=float, help="Angle of the projection in degrees. Default: the first angle of the scan.")
@set_option
@json_option
def tune(file: Path, angle: float | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Take a few frames, and report counts, saturation, transmission, noise and the exposure time to use.

    \b
    beamline tune my.yaml

    The command takes two darks, two flats and one projection. The shutter opens, the sample moves out and back, and
    the stage turns to the angle of the projection and back. The difference of two frames of one kind shows the noise.
    The command also takes flats and the projection with an eighth and a 64th of the exposure time, in case they
    saturate. It writes no file.

    Exit code: 0 done, 2 wrong configuration, 3 a device failed, 4 stopped, 6 the darks or flats would stop a scan.
    """
    from beamline.features.tuning.tune import tune as tune_exposure

    result = evaluated(file, overrides, as_json, tune_exposure, angle)
    if result.faults:
        if math.isnan(result.advised):
            raise QualityError(
                "A scan with these darks and flats would stop, and another exposure time would not help: see FAULT "
                "above."
            )
        raise QualityError(
            f"Set the exposure to {result.advised:.4g} s: with the present exposure, a scan would stop because of "
            f"its darks or flats."
        )


def evaluated(
    file: Path, overrides: Sequence[str], as_json: bool,
    evaluate: Callable[[Config, ConnectedDevices, StopRequest, Sink, float | None], Found], angle: float | None,
) -> Found:  # fmt: skip
    """The result of `evaluate` for projections from `angle` (degrees) on, printed as lines or JSON."""
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
@click.option(
    "--angle", type=float, help="Angle of the first projection in degrees. Default: the first angle of the scan."
)
@set_option
@json_option
def align(file: Path, angle: float | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Take two opposite projections (180° apart); report rotation axis, tilt and focus, and how to correct them.

    \b
    beamline align my.yaml

    The shutter opens, the sample moves out and back, and the stage turns to both angles and back. Correct what the
    command reports, and call it again. No file is written.

    Exit code: 0 done, 2 wrong configuration, 3 a device failed, 4 stopped, 6 the projections show no axis.
    """
    from beamline.features.tuning.align import align as align_views

    evaluated(file, overrides, as_json, align_views, angle)
