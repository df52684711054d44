"""`beamline align`: a pair of views before a scan says where the axis is, how it leans, and how sharp views are."""

from __future__ import annotations

from pathlib import Path

import click

from beamline.cli.options import FiniteRange, config_argument, json_option, set_option
from beamline.cli.tune import evaluated


@click.command()
@config_argument
@click.option(
    "--angle", type=FiniteRange(), help="Angle of the first view, degrees. Default: the first one of the scan."
)
@set_option
@json_option
def align(file: Path, angle: float | None, overrides: tuple[str, ...], as_json: bool) -> None:
    """Take a pair of views half a turn apart, and say axis, tilt and sharpness, with the correction of each.

    The shutter opens, the sample goes out and back, the stage turns to both angles and back. Mend what is said, and
    call it again. Nothing is written.

    Exit code: 0 done, 2 wrong configuration, 3 a device failed, 4 stopped, 6 the views show no axis.
    """
    from beamline.scan.align import align as align_views

    evaluated(file, overrides, as_json, align_views, angle)
