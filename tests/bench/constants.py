"""Every number at module level of recon, and every limit in its code, by class; `python -m tests.bench.constants`.

The classes are given by hand in constants.txt: a line names a module, a class, and its names, or =limits in its code.

a: mathematics, physics, a published value, or a convention of statistics (so many standard errors).
b: numerics and machines: rounding, sizes of tiles and samples, iterations, costs.
c: empirical: somebody found it on data, and it changes a volume or a choice.
d: empirical, but it only changes what is told: warnings, and figures of reports.
m: a table that a script measures.
"""

from __future__ import annotations

import ast
import sys
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
EMPIRICAL = "base.empirical"


def numbers(value: ast.expr) -> int:
    """How many numbers an expression at module level gives; a product of some is one."""
    match value:
        case ast.Constant(value=bool() | str() | bytes() | None):
            return 0
        case ast.Constant(value=int() | float()):
            return 1
        case ast.Tuple(elts=parts) | ast.List(elts=parts):
            return sum(map(numbers, parts))
        case ast.Dict(values=parts):
            return sum(map(numbers, parts))
        case ast.BinOp(left=left, right=right):
            return int(numbers(left) > 0 or numbers(right) > 0)
        case ast.UnaryOp(operand=operand):
            return numbers(operand)
        case ast.Call(args=args, keywords=keywords):
            return sum(map(numbers, args)) + sum(numbers(each.value) for each in keywords)
    return 0


def named(target: ast.expr) -> list[str]:
    if isinstance(target, ast.Name):
        return [target.id]
    return [name for part in getattr(target, "elts", []) for name in named(part)]


def of_module(path: Path) -> dict[str, int]:
    """Names at module level, and how many numbers each holds."""
    found: dict[str, int] = {}
    for statement in ast.parse(path.read_text()).body:
        if not isinstance(statement, ast.Assign | ast.AnnAssign) or statement.value is None:
            continue
        target = statement.targets[0] if isinstance(statement, ast.Assign) else statement.target
        names, value = named(target), statement.value
        parts = value.elts if isinstance(value, ast.Tuple) and len(value.elts) == len(names) > 1 else None
        for at, name in enumerate(names):
            count = numbers(parts[at]) if parts else numbers(value) if at == 0 else 0
            if count:
                found[name] = count
    return found


def classes() -> dict[tuple[str, str], str]:
    """Class of each (module, name or =limit)."""
    given: dict[tuple[str, str], str] = {}
    for line in Path(__file__).with_suffix(".txt").read_text().splitlines():
        module, kind, *names = line.split()
        given |= dict.fromkeys(((module, name) for name in names), kind)
    return given


def main() -> int:
    given, counts, unknown = classes(), Counter[tuple[str, str]](), []
    seen: set[tuple[str, str]] = set()
    for path in sorted((ROOT / "recon").rglob("*.py")):
        module = str(path.relative_to(ROOT / "recon"))[:-3].replace("/", ".")
        for name, count in of_module(path).items():
            kernel = "b" if module.startswith("kernels.") else "c" if module == EMPIRICAL else None
            kind = given.get((module, name), kernel)
            seen.add((module, name))
            if kind is None:
                unknown.append(f"{module}.{name}")
            else:
                counts[kind, module] += count
    for (module, name), kind in given.items():
        if name.startswith("="):
            counts[kind, module] += 1
        elif (module, name) not in seen:
            unknown.append(f"{module}.{name} is no longer there")
    for kind in "abcdm":
        print(kind, sum(count for (each, _), count in counts.items() if each == kind))
    print("c by module:", *(f"{module} {count}" for (kind, module), count in sorted(counts.items()) if kind == "c"))
    print(*unknown, sep="\n")
    return len(unknown)


if __name__ == "__main__":
    sys.exit(main())
