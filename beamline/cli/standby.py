"""Standby process: before a scan starts, it loads the modules that a live reconstruction needs. Then it waits for the
command.

`python -m beamline.cli.standby` waits for a line of JSON on its stdin, with a file for its stderr and the words of a
command. From then on, the process runs as this command. It ends when its stdin closes.
"""

from __future__ import annotations

import json
import os
import sys

from beamline.cli.main import run


def main() -> None:
    """Warm up, wait, and run."""
    import beamline.reconstruct.pipeline  # noqa: F401 - the command does so, too
    from recon.splatting.r2 import R2
    from recon.warm_up import warm_up

    warm_up(R2(finish=0))
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as stdin:  # the next reader of stdin gets the rest
        if not (line := stdin.readline()):
            return
    log, *words = json.loads(line)
    os.dup2(os.open(log, os.O_WRONLY | os.O_APPEND), sys.stderr.fileno())
    sys.argv[1:] = words
    run()


if __name__ == "__main__":
    main()
