"""The empirical constants of recon: their number is limited, each states its evidence, and each is used."""

from __future__ import annotations

import ast
import re
from pathlib import Path

from recon.base import empirical

SOURCE = Path(empirical.__file__)
MOST = 34


def _constants() -> list[tuple[list[str], str]]:
    """Names of each assignment, and the text behind it."""
    body = [statement for statement in ast.parse(SOURCE.read_text()).body if not isinstance(statement, ast.ImportFrom)]
    found = []
    for statement, after in zip(body[1:], [*body[2:], None], strict=True):
        if isinstance(statement, ast.Assign):
            (target,) = statement.targets
            parts = target.elts if isinstance(target, ast.Tuple) else [target]
            names = [part.id for part in parts if isinstance(part, ast.Name)]
            text = after.value.value if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) else ""
            found.append((names, str(text)))
    return found


def test_they_are_few_and_each_says_what_is_lost_without_it() -> None:
    constants = _constants()
    assert 0 < sum(len(names) for names, _ in constants) <= MOST
    silent = [names for names, text in constants if not re.search(r"Without|With |dB|`[A-Z_]+`", text)]
    assert not silent


def test_each_is_used() -> None:
    sources = [path.read_text() for path in SOURCE.parents[1].rglob("*.py") if path != SOURCE]
    used = {name for text in sources if "recon.base.empirical import" in text for name in _imported(text)}
    assert used == {name for names, _ in _constants() for name in names}


def _imported(text: str) -> list[str]:
    return [
        alias.name
        for statement in ast.parse(text).body
        if isinstance(statement, ast.ImportFrom) and statement.module == "recon.base.empirical"
        for alias in statement.names
    ]
