"""The instrument and what surrounds it: configuration, scans, files, monitoring, reconstruction, reports, commands."""

import sys

from beamline.core.installed import package_problem

if _problem := package_problem(__path__[0].removesuffix("beamline").rstrip("/\\")):
    # A command says it in one line, without a traceback.
    raise (SystemExit if sys.argv[0].endswith(("beamline", "beamline.exe")) else ImportError)(_problem)


def __getattr__(name: str) -> str:
    if name == "__version__":
        from beamline.core.installed import version

        return version()
    raise AttributeError(f"module 'beamline' has no attribute {name!r}")
