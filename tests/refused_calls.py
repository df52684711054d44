"""Calls that raise an error, with their messages, in a text file test_it.refused.txt next to test_it.py.

The text file begins with imports. Then each call has two lines, followed by an empty line:

    parse_views('fixed:181', HALF)
    ValueError: ...

Names that are not imported are those of the test module.

`python -m tests.refused_calls [FILE ...]` rewrites the second lines (without a name: of all files). Read the
differences.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

SUFFIX = ".refused.txt"


def said(call: str, names: dict[str, Any]) -> str:
    """The class of the error and its message on one line."""
    try:
        found = eval(call, names)
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())}"
    raise AssertionError(f"{call} raises no error, and returns {found!r}")


def read(path: Path) -> tuple[str, list[tuple[str, str]]]:
    """The imports, and the calls with their messages."""
    imports, *pairs = path.read_text(encoding="utf-8").rstrip("\n").split("\n\n")
    return imports, [(call, words) for call, _, words in (pair.partition("\n") for pair in pairs)]


def refused_calls(module: str, names: dict[str, Any]) -> Callable[..., None]:
    """The test of the calls that belong to a test module, from its `__file__` and `globals()`."""
    imports, calls = read(Path(module).with_suffix(SUFFIX))

    @pytest.mark.parametrize(("call", "words"), calls, ids=[call for call, _ in calls])
    def test(call: str, words: str) -> None:
        known = dict(names)
        exec(imports, known)
        found = said(call, known)
        assert found == words, f"{found}, and not {words}"

    return test


def main(files: list[str]) -> None:
    warnings.simplefilter("error")
    for path in map(Path, files) if files else Path("tests").rglob(f"*{SUFFIX}"):
        imports, calls = read(path)
        names = dict(vars(import_module(str(path).removesuffix(SUFFIX).replace("/", "."))))
        exec(imports, names)
        pairs = [f"{call}\n{said(call, names)}" for call, _ in calls]
        path.write_text("\n\n".join([imports, *pairs]) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main(sys.argv[1:])
