"""Error messages that a test expects, in a text file test_it.messages.txt next to test_it.py.

A test writes `with refused(ValueError): ...` in place of `pytest.raises(ValueError, match="...")`. Each error has two
lines in the text file, followed by an empty line: the name of the test, then the class of the error and its message. So
the whole message is compared, and a sentence of the product is changed in one place. Folders of a test run are TMP.

`python -m tests.messages [FILE ...]` runs these test files (without a name: all that have such a text file) and
rewrites the text files. Read the differences.
"""

from __future__ import annotations

import atexit
import os
import re
import subprocess
import sys
from collections import defaultdict
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

import pytest

SUFFIX = ".messages.txt"
WRITE = "SPLATLINE_WRITE_MESSAGES"
ROOT = Path(__file__).parents[1]

temporary = [""]
"""The folder in which the tests of this process have theirs; conftest.py sets it."""
_so_far: dict[Path, dict[str, list[str]]] = {}
_last = [("", 0)]  # the test that runs now, and how many of its errors came


_E = TypeVar("_E", bound=BaseException)


class refused(Generic[_E]):  # noqa: N801 - used like pytest.raises
    """Expects an error of a class (as `pytest.raises`), with the next message of this test in the text file."""

    def __init__(self, expected: type[_E] | tuple[type[_E], ...]) -> None:
        self._raises = pytest.raises(expected)
        self._path = Path(sys._getframe(1).f_code.co_filename).with_suffix(SUFFIX)

    def __enter__(self) -> pytest.ExceptionInfo[_E]:
        self._caught = self._raises.__enter__()
        return self._caught

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> bool:
        if not self._raises.__exit__(kind, error, trace):
            return False
        test = os.environ["PYTEST_CURRENT_TEST"].partition("::")[2].rpartition(" ")[0]
        nth = _last[0][1] if _last[0][0] == str(self._path) + test else 0
        _last[0] = str(self._path) + test, nth + 1
        found = said(self._caught.value)
        if os.environ.get(WRITE):
            _write_at_exit(self._path, test, found)
            return True
        words = [*read(self._path).get(test, []), *[""] * (nth + 1)][nth]
        assert found == words, f"{found}, and not {words or 'in the text file'}"
        return True


def said(error: BaseException) -> str:
    """The class of an error and its message on one line."""
    text = " ".join(str(error).split())
    if temporary[0]:
        text = re.sub(re.escape(temporary[0]) + r"/[\w-]+", "TMP", text)
    return f"{type(error).__name__}: {text}"


@cache
def read(path: Path) -> dict[str, list[str]]:
    """The messages by the name of the test."""
    found = defaultdict[str, list[str]](list)
    if path.exists():
        for pair in path.read_text(encoding="utf-8").rstrip("\n").split("\n\n"):
            test, _, words = pair.partition("\n")
            found[test].append(words)
    return dict(found)


def _write_at_exit(path: Path, test: str, found: str) -> None:
    if not _so_far:
        atexit.register(_write)
    _so_far.setdefault(path, {}).setdefault(test, []).append(found)


def _write() -> None:
    """Write the messages of the tests that ran. Those of other tests stay (they may be slow), if the tests exist."""
    for path, anew in _so_far.items():
        source = path.with_name(path.name.replace(SUFFIX, ".py")).read_text(encoding="utf-8")
        names = re.findall(r"def (test_\w+)", source)
        stay = {test: words for test, words in read(path).items() if _function(test) in names}
        merged = sorted((stay | anew).items(), key=lambda item: names.index(_function(item[0])))
        pairs = [f"{test}\n{words}" for test, messages in merged for words in messages]
        path.write_text("\n\n".join(pairs) + "\n", encoding="utf-8")


def _function(test: str) -> str:
    """The name of the function of a test, without its class and its parameters."""
    return test.partition("[")[0].rpartition("::")[2]


def main(files: list[str]) -> None:
    found = files or [
        str(path.with_name(path.name.replace(SUFFIX, ".py"))) for path in sorted((ROOT / "tests").rglob(f"*{SUFFIX}"))
    ]
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", *found]
    sys.exit(subprocess.run(command, cwd=ROOT, env=os.environ | {WRITE: "1"}, check=False).returncode)


if __name__ == "__main__":
    main(sys.argv[1:])
