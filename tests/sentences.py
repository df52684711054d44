"""Sentences of docstrings, messages, comments and pages that are too long, or hard to read at first sight.

Run from the root of the checkout with  python -m tests.sentences recon docs ...  to list them.
"""

from __future__ import annotations

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONGEST = 25
"""Words of a sentence."""
HARD = (
    r"\bof which\b",
    r"\bis none of\b",
    r"\bnone of the [\w ]+['’]s\b",
    r"\bwhich of which\b",
    r"\bthat is none\b",
)
"""Patterns that a reader has to read twice."""

_END = re.compile(r"(?<=[.!?])[\"')]?\s+(?=\S)")
_ABBREVIATION = re.compile(r"\b(e\.g|i\.e|ch|Sec|Eq|Fig|vol|al|Opt|Med|Trans|Phys|Biol|Appl|[A-Z])\.(?=\s)")
_WORD = re.compile(r"(?=\S*(?:[^\W\d_]{2}|\d))\S+")
_ITEM = re.compile(r"^(\s*)(?:[-*] |\d+\. |\d+ {2,}|[\w*, /.<>`]{1,60}: (?=\S)|#+ )")


@dataclass(frozen=True)
class Sentence:
    """A sentence and where it stands.

    Attributes:
        kind: "docstring", "message", "comment" or "page".
    """

    path: Path
    line: int
    kind: str
    text: str

    @property
    def words(self) -> int:
        """Words and numbers; a formula's single letters are none."""
        return len(_WORD.findall(self.text))

    @property
    def hard(self) -> bool:
        """Whether it has to be read twice."""
        return (self.words > LONGEST and not self.text.isupper()) or any(
            re.search(pattern, self.text) for pattern in HARD
        )

    def __str__(self) -> str:
        return f"{self.path}:{self.line}: {self.kind}, {self.words} words: {self.text}"


def split(text: str) -> list[str]:
    """The sentences of a text. Items of lists, entries of Args and rows in columns are texts of their own.

    Names of code count as one word.
    """
    parts: list[str] = [""]
    for line in text.splitlines():
        if not line.strip():
            parts.append("")
        elif re.search(r"\S {3,}\S", line):
            parts += [line, ""]
        elif item := _ITEM.match(line):
            parts.append(line[item.end() :])
        else:
            parts[-1] += f"\n{line}"
    joined = (" ".join(re.sub(r"`+[^`]*`+", "code", part).split()) for part in parts)
    return [each for part in joined for each in _END.split(_ABBREVIATION.sub(r"\1", part)) if each]


def sentences(path: Path) -> Iterator[Sentence]:
    """All sentences of a module, or of a page in Markdown."""
    text = path.read_text(encoding="utf-8")
    found = _of_module(text) if path.suffix == ".py" else _of_page(text)
    yield from (Sentence(path, line, kind, each) for kind, line, part in found for each in split(part))


def _of_page(text: str) -> Iterator[tuple[str, int, str]]:
    """Paragraphs and cells of tables, without code."""
    prose = re.sub(r"(?ms)^```.*?^```", lambda match: "\n" * match[0].count("\n"), text)
    for block in re.finditer(r"(?:^.*\S.*$\n?)+", prose, flags=re.M):
        line = 1 + prose.count("\n", 0, block.start())
        if block[0].startswith("|"):
            for number, row in enumerate(block[0].splitlines()):
                yield from (("page", line + number, cell) for cell in row.split("|"))
        else:
            yield "page", line, re.sub(r"\]\([^)]*\)", "]", block[0])


def _of_module(text: str) -> Iterator[tuple[str, int, str]]:
    tree = ast.parse(text)
    documented: set[ast.AST] = set()
    for node in ast.walk(tree):
        for statement in getattr(node, "body", ()) if isinstance(getattr(node, "body", None), list) else ():
            value = statement.value if isinstance(statement, ast.Expr) else None
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                documented.add(value)
                yield "docstring", value.lineno, value.value
    inner = {part for node in ast.walk(tree) if isinstance(node, ast.JoinedStr) for part in node.values}
    for node in ast.walk(tree):
        if isinstance(node, ast.JoinedStr):
            said = "".join(str(part.value) if isinstance(part, ast.Constant) else "n" for part in node.values)
            yield "message", node.lineno, said
        elif isinstance(node, ast.Constant) and isinstance(node.value, str) and node not in documented | inner:
            yield "message", node.lineno, node.value if " " in node.value else ""
    yield from _comments(text)


def _comments(text: str) -> Iterator[tuple[str, int, str]]:
    """Runs of lines that are comments, and each comment beside code by itself."""
    run: list[str] = []
    last = 0
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.COMMENT:
            continue
        said, line = token.string.lstrip("# "), token.start[0]
        if token.line.strip().startswith("#"):
            if run and line != last + 1:
                yield "comment", last, "\n".join(run)
                run = []
            run.append(said)
            last = line
        else:
            yield "comment", line, said
    yield "comment", last, "\n".join(run)


def files(*roots: Path) -> list[Path]:
    """Modules and pages below folders, or the files themselves."""
    found = [path for root in roots for path in ([root] if root.is_file() else root.rglob("*"))]
    return sorted(path for path in found if path.suffix in (".py", ".md") and "notes" not in path.parts)


def hard(*roots: Path) -> list[Sentence]:
    """The sentences below `roots` that are to be rewritten."""
    return [sentence for path in files(*roots) for sentence in sentences(path) if sentence.hard]


if __name__ == "__main__":
    sys.stdout.writelines(f"{sentence}\n" for sentence in hard(*map(Path, sys.argv[1:])))
