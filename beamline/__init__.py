"""beamline: configuration of the instrument, scans, files, monitoring, reconstruction, reports and commands."""

import sys

from beamline.core.installed import as_one_line, package_problem

if sys.argv[0].endswith(("beamline", "beamline.exe")):
    sys.excepthook = as_one_line  # of what a command loads before it can say anything
if _problem := package_problem(__path__[0].removesuffix("beamline").rstrip("/\\")):
    raise ImportError(_problem, name="splatline")


def __getattr__(name: str) -> str:
    if name == "__version__":
        from beamline.core.installed import version

        return version()
    raise AttributeError(f"module 'beamline' has no attribute {name!r}")
