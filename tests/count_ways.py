"""Counts the ways that one thing is done: pipelines of a reconstruction, values that hold its volume, needs.

python -m tests.count_ways [ROOT]
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator
from pathlib import Path

PREPARES = {
    "prepare_within", "prepare_projections", "prepare_energies", "ScanFollower", "finished_views",
    "growing_views",
}  # fmt: skip
"""What turns a source into line integrals."""
WRITES = {"write_result", "write_volume", "write_reconstruction"}
"""What takes a volume that was made."""
HOLD = {"Volume", "VolumeSeries", "VolumesInTime", "Reconstruction", "ReconRecord"}
"""Types by which a value holds a volume."""
KEPT = {"recon_record", "events", "reconstruction"}
"""Modules beside recon and `reconstruct/` that may hold one: of files, events and scripts."""
NEED = {"memory", "at_once", "seconds", "least_seconds", "scratch", "output", "least"}
"""Names of which a statement of what a reconstruction needs has two or more."""
LINES, PARAMETERS, MODULE = 60, 8, 350


def modules(root: Path) -> Iterator[tuple[Path, ast.Module]]:
    for package in ("beamline", "recon"):
        for path in sorted((root / package).rglob("*.py")):
            yield path.relative_to(root), ast.parse(path.read_text(encoding="utf-8"))


def called(node: ast.AST) -> set[str]:
    """Names of what is called, or handed on, within a node."""
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def pipelines(path: Path, tree: ast.Module) -> Iterator[str]:
    """Functions that lead from a source to a written volume, by themselves or by others of their module."""
    own = {each.name: called(each) for each in tree.body if isinstance(each, ast.FunctionDef)}
    for node in tree.body:
        if not isinstance(node, ast.FunctionDef):
            continue
        reached, ahead = set[str](), {node.name}
        while ahead:
            reached |= ahead
            ahead = {name for each in ahead for name in own.get(each, set())} - reached
        if reached & PREPARES and reached & WRITES:
            yield f"{path}:{node.lineno} {node.name}"


def fields_of(node: ast.ClassDef) -> dict[str, str]:
    """Annotated fields and properties of a class, by name."""
    fields = {
        each.target.id: ast.unparse(each.annotation)
        for each in node.body
        if isinstance(each, ast.AnnAssign) and isinstance(each.target, ast.Name)
    }
    for each in node.body:
        if isinstance(each, ast.FunctionDef) and any(ast.unparse(d) == "property" for d in each.decorator_list):
            fields[each.name] = "" if each.returns is None else ast.unparse(each.returns)
    return fields


def is_kernel(path: Path, node: ast.FunctionDef) -> bool:
    return "kernels" in path.parts or any("njit" in ast.unparse(each) for each in node.decorator_list)


def is_value(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(each) for each in node.decorator_list)


def names_in(annotation: str) -> set[str]:
    return {each.id for each in ast.walk(ast.parse(annotation or "None")) if isinstance(each, ast.Name)}


def main(root: Path) -> None:
    found: dict[str, list[str]] = {
        name: []
        for name in ("pipelines", "values that hold a volume", "statements of need", f"functions over {LINES} lines",
                     f"functions of more than {PARAMETERS} parameters", f"modules over {MODULE} lines")
    }  # fmt: skip
    ways, volumes, needs, long, wide, large = found.values()
    for path, tree in modules(root):
        if "reconstruct" in path.parts:
            ways.extend(pipelines(path, tree))
        if (lines := (root / path).read_text(encoding="utf-8").count("\n")) > MODULE:
            large.append(f"{path} {lines}")
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef):
                length = (node.end_lineno or 0) - node.lineno + 1
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                n_given = sum(each.arg not in {"self", "cls"} for each in given)
                if not is_kernel(path, node) and length > LINES:
                    long.append(f"{path}:{node.lineno} {node.name} {length}")
                if not is_kernel(path, node) and n_given > PARAMETERS:
                    wide.append(f"{path}:{node.lineno} {node.name} {n_given}")
            if isinstance(node, ast.ClassDef) and is_value(node):
                fields = fields_of(node)
                may_hold = "reconstruct" in path.parts or path.parts[0] == "recon" or path.stem in KEPT
                if may_hold and any(names_in(each) & HOLD for each in fields.values()):
                    volumes.append(f"{path}:{node.lineno} {node.name}")
                asks = "Request" in node.name  # for a work: what a command was given
                if len(set(fields) & NEED) > 1 and path.parts[0] == "beamline" and not asks:
                    needs.append(f"{path}:{node.lineno} {node.name}")
    for what, places in found.items():
        print(f"{len(places):>4}  {what}")
        for place in places:
            print(f"        {place}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "."))
