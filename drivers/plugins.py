"""Plug-ins: additions of other installed packages to a registry, by entry points of the group `splatline.KIND`.

KIND is method, correction, reader, volume_format, stage, wire, camera, check or effect; the entry point's name is the
name of the addition. A registry asks at its first use, so that programs without it start quickly.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import redirect_stdout
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from typing import Any

_PREFIX = "splatline."


def plugins(
    kind: str, taken: Collection[str], made: Callable[[str, Any], Any] = lambda name, target: target
) -> dict[str, Any]:
    """The additions of other packages to a registry, by name, in the order of the names.

    Args:
        kind: of the registry, as above.
        taken: names that the registry has itself.
        made: makes the registry's entry from a name and the loaded object; ValueError if the object does not fit.

    Warns:
        UserWarning: a plug-in is left out because its name is taken, it cannot be loaded, or it does not fit.
    """
    announced = sorted(point for point in _announced() if point.group == _PREFIX + kind)
    times, loaded = Counter(point.name for point in announced), dict[str, Any]()
    for point in announced:
        try:
            if point.name in taken or times[point.name] > 1:
                by = "splatline" if point.name in taken else "another plug-in"
                raise ValueError(f"the name is taken by {by}; expected a name of its own")
            with redirect_stdout(sys.stderr):  # stdout is for results
                loaded[point.name] = made(point.name, point.load())
        except KeyboardInterrupt:
            raise
        except BaseException as error:  # another package's fault must not stop a scan
            package = f" of the package {point.dist.name}" if point.dist is not None else ""
            told = f"{point.name!r}{package} ({point.value}) was left out: {type(error).__name__}: {_message(error)}"
            warnings.warn(
                f"The {kind.replace('_', ' ')} {_one_line(told)}. Mend or uninstall that package; all else works "
                "without it.",
                stacklevel=2,
            )
    return loaded


def _message(error: BaseException) -> str:
    try:
        return str(error)
    except BaseException as again:  # from the text of another package's error, too
        return f"it does not say why ({type(again).__name__})"


def _one_line(text: str) -> str:
    """The text without control characters, which would act on a terminal or begin a line of a log; not too long."""
    line = " ".join(text[:1000].split())
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


@cache
def _announced() -> tuple[EntryPoint, ...]:
    """Entry points of all installed packages; reading them takes a tenth of a second, once a process."""
    groups = entry_points()
    return tuple(point for group in groups.groups if group.startswith(_PREFIX) for point in groups.select(group=group))
