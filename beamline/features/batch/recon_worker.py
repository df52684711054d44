"""The process that reconstructs the scans of a batch: python -m beamline.features.batch.recon_worker.

Each line of stdin is a JSON list, the arguments of `beamline`. Its output goes to stdout, then the event `ended`
with its exit code. The process ends with its stdin.
"""

from __future__ import annotations

import json
import sys
import traceback
from collections.abc import Sequence

from click import ClickException

from beamline.cli.main import main
from beamline.core.errors import BeamlineError


def run(arguments: Sequence[str]) -> int:
    """The exit code of `beamline` with these arguments."""
    try:
        code = main(list(arguments), prog_name="beamline", standalone_mode=False)
    except ClickException as error:
        error.show()
        return error.exit_code
    except Exception:
        traceback.print_exc()
        return BeamlineError.exit_code
    return code if isinstance(code, int) else 0


def serve() -> None:
    for line in sys.stdin:
        code = run(json.loads(line))
        sys.stderr.flush()
        sys.stdout.write(json.dumps({"event": "ended", "exit_code": code}) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    serve()
