"""Which small faults of a module its tests see: python -m tests.bench.mutation N MODULE.py TESTS...

N mutants (a comparison turned round, + for -, a constant changed, a statement dropped), each in a process forked before
anything of the project is imported; the tree is never touched. A line of JSON each, with the first test that fails:
compare those before and after tests were deleted. Linux; not for compiled kernels, whose cache knows files.
"""

from __future__ import annotations

import ast
import copy
import importlib.abc
import importlib.util
import json
import os
import random
import signal
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

SECONDS = 240  # for a mutant, which may never end
_PAIRS = (
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.Lt, ast.GtE), (ast.Gt, ast.LtE), (ast.Eq, ast.NotEq),
    (ast.Is, ast.IsNot), (ast.In, ast.NotIn), (ast.And, ast.Or),
)  # fmt: skip
_SWAPS: dict[type, type] = {a: b for pair in _PAIRS for a, b in (pair, pair[::-1])}


def _changed(node: ast.AST) -> Any:
    """The node with one fault in it; None where it is of none of these kinds."""
    new: Any = copy.deepcopy(node)
    match new:
        case ast.BinOp(op=op) | ast.BoolOp(op=op) if type(op) in _SWAPS:
            new.op = _SWAPS[type(op)]()
        case ast.Compare(ops=[op, *_]) if type(op) in _SWAPS:
            new.ops[0] = _SWAPS[type(op)]()
        case ast.Constant(value=bool(value)):
            new.value = not value
        case ast.Constant(value=int(value)) | ast.Constant(value=float(value)):
            new.value = value * 2 + 1
        case ast.Return(value=ast.expr()):
            new.value = ast.Constant(None)
        case ast.If(test=test) | ast.IfExp(test=test):
            new.test = ast.UnaryOp(ast.Not(), test)
        case ast.Expr(value=ast.Call()) | ast.Raise() | ast.AugAssign():
            return ast.Pass()
        case _:
            return None
    return new


def mutants(source: str) -> Iterator[tuple[str, str]]:
    """A name and the source of each."""
    tree = ast.parse(source)
    for parent in ast.walk(tree):
        for field, value in ast.iter_fields(parent):
            held: Any = value if isinstance(value, list) else vars(parent)
            for place in range(len(value)) if isinstance(value, list) else [field]:
                node = held[place]
                if isinstance(node, ast.expr | ast.stmt) and (new := _changed(node)) is not None:
                    held[place] = ast.copy_location(new, node)
                    name = f"{node.lineno}:{node.col_offset} {ast.unparse(node)} -> {ast.unparse(new)}"
                    yield name.replace("\n", " ")[:150], ast.unparse(ast.fix_missing_locations(tree))
                    held[place] = node


class _Mutated(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):  # type: ignore[misc]
    def __init__(self, path: Path, source: str) -> None:
        self.path, self.source, self.name = path, source, ".".join(path.with_suffix("").parts)

    def find_spec(self, name: str, *_: object) -> Any:
        return importlib.util.spec_from_file_location(name, self.path, loader=self) if name == self.name else None

    def get_filename(self, name: str) -> str:
        return str(self.path)

    def get_data(self, path: str) -> bytes:
        if path.endswith(".pyc"):
            raise OSError("a mutant is compiled each time")
        return self.source.encode()


def killer(path: Path, source: str, tests: list[str]) -> str:
    """The first test that fails; "" for none."""
    failed: list[str] = []
    with tempfile.NamedTemporaryFile("r") as told:
        if not (child := os.fork()):
            os.setsid()
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1), os.dup2(1, 2)
            sys.meta_path.insert(0, _Mutated(path, source))
            import pytest

            class Seen:
                def pytest_runtest_logreport(self, report: Any) -> None:
                    failed.extend([report.nodeid] * report.failed)

                pytest_collectreport = pytest_runtest_logreport

            code = pytest.main(["-qx", "-pno:cacheprovider", "-pno:randomly", *tests], [Seen()])
            Path(told.name).write_text(failed[0] if failed else f"exit code {int(code)}" * bool(code))
            os._exit(0)
        signal.signal(signal.SIGALRM, lambda *_: os.killpg(child, signal.SIGKILL))
        signal.alarm(SECONDS)
        ended = os.waitpid(child, 0)[1] == 0
        signal.alarm(0)
        return told.read() if ended else "no end"


if __name__ == "__main__":
    import h5py, numpy, pydantic, pytest, scipy.optimize  # noqa: E401, F401, I001 - each mutant has them; numba: after recon

    n, path, tests = int(sys.argv[1]), Path(sys.argv[2]), sys.argv[3:]
    text = path.read_text(encoding="utf-8")
    if unchanged := killer(path, ast.unparse(ast.parse(text)), tests):
        sys.exit(f"This fails without a fault: {unchanged}")
    every = list(mutants(text))
    for i in sorted(random.Random(0).sample(range(len(every)), min(n, len(every)))):
        name, faulty = every[i]
        line = {"module": str(path), "mutant": name, "killed_by": killer(path, faulty, tests)}
        print(json.dumps(line), flush=True)
