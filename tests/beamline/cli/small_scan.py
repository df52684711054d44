"""Shared by the tests of `beamline recon`: a small scan, a call as a user makes it, and the files that the call
writes."""

from pathlib import Path

import numpy as np
from click.testing import CliRunner, Result

from beamline.cli.main import main
from tests.beamline.scans import TwoCylinders

SCAN = TwoCylinders(angles=np.radians(np.arange(0, 180, 6.0)), shape=(2, 40), pixel_size_mm=0.5)


def beamline(*arguments: object) -> Result:
    return CliRunner().invoke(main, [str(argument) for argument in arguments])


def succeeds(*arguments: str) -> Result:
    """Run a command that must succeed."""
    result = beamline(*arguments)
    assert result.exit_code == 0, result.output
    return result


def left(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}
