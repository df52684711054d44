"""Configuration errors: pydantic's findings with file and line, the key, its value and the legal values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml
from pydantic import ValidationError

from beamline.config.tree import KeyPath, Tree
from recon.base.registry import did_you_mean

Schema = Mapping[str, Any]
_OF_VALIDATOR = "Value error, "  # before the message of a validator of ours


def explain(error: ValidationError, tree: Tree, schema: Schema) -> list[str]:
    """One line for each fault, in the order of the model's keys; one fault a key.

    Args:
        schema: the model's JSON schema, from which the legal keys and values are read.
    """
    faults: dict[KeyPath, str] = {}
    all_found = error.errors(include_url=False)
    real = _keys_of_real(all_found, tree.data, schema)
    for finding in all_found:
        missing = finding["type"] == "missing" and isinstance(finding["loc"][-1], str)  # not a missing item of a list
        path = _path(finding["loc"], tree.data, missing)
        if finding["type"].startswith("union_tag"):
            path = (*path, finding["ctx"]["discriminator"].strip("'"))
            missing = finding["type"] == "union_tag_not_found"
        if path and path[-1] in (keys := real.get(path[:-1], [])):
            if path[-1] == keys[0]:
                faults[path] = f"{tree.origin(path)}: {_keys_sentence(path[:-1], keys, tree.data)}"
            continue
        sentence = _sentence("missing" if missing else finding["type"], path, finding["msg"], tree.data, schema)
        place = tree.origin((*path, *_key_named(finding["type"], finding["msg"])))
        faults.setdefault(path, f"{place}: {sentence}")
    # A list with a wrong item may also seem too short.
    lists = {path for path in faults if isinstance(_value(tree.data, path), list)}
    items = {path[:-1] for path in faults if path}
    return [text for path, text in faults.items() if path not in lists & items]


def _keys_of_real(found: Sequence[Any], data: Any, schema: Schema) -> dict[KeyPath, list[str]]:
    """Of each group of a simulated device: the keys that it does not have, and its real counterpart has."""
    keys: dict[KeyPath, list[str]] = {}
    for each in found:
        path = _path(each["loc"], data, False)
        if each["type"] != "extra_forbidden" or not path:
            continue
        group = _value(data, path[:-1])
        others = [key for branch in declared_at(schema, path[:-1], None) for key in branch.get("properties", {})]
        if str(group.get("kind", "")).startswith("simulated") and path[-1] in others:
            keys.setdefault(path[:-1], []).append(str(path[-1]))
    return keys


def _keys_sentence(group: KeyPath, keys: Sequence[str], data: Any) -> str:
    name, kind = ".".join(map(str, group)), _value(data, group)["kind"]
    return (
        f"{name}: {', '.join(keys)} belong{'s' if len(keys) == 1 else ''} to a real device, and its kind is {kind}; "
        "leave out what it does not have, or take the real configuration as it is: `beamline scan CONFIG --rehearse`"
    )


def _path(loc: Sequence[str | int], data: Any, missing: bool) -> KeyPath:
    """The key path in the file: pydantic's location without the names of union members."""
    path: list[str | int] = []
    for at, part in enumerate(loc):
        if _has(data, part):
            data = data[part]
            path.append(part)
        elif missing and at == len(loc) - 1:
            path.append(part)
    return tuple(path)


def _has(data: Any, part: str | int) -> bool:
    if isinstance(data, list):
        return isinstance(part, int) and part < len(data)
    return isinstance(data, dict) and part in data


def _key_named(kind: str, message: str) -> KeyPath:
    """The path of the key, within its group, with which the message of a group's validator begins."""
    words = message.removeprefix(_OF_VALIDATOR).split(maxsplit=1)
    return tuple(words[0].rstrip(":,").split(".")) if kind == "value_error" and words else ()


def _sentence(kind: str, path: KeyPath, message: str, data: Any, schema: Schema) -> str:
    name = ".".join(map(str, path)) or "the configuration"
    if kind == "value_error":
        sentence = message.removeprefix(_OF_VALIDATOR)
        return f"{name}: {sentence}" if path else sentence
    if kind == "extra_forbidden":
        keys = [key for branch in declared_at(schema, path[:-1], data) for key in branch.get("properties", {})]
        return f"{name} is not a known key{did_you_mean(path[-1], keys)}; legal keys there: {', '.join(keys)}"
    branches = declared_at(schema, path, data)
    choices = [str(choice) for branch in branches for choice in _choices(branch)]
    words = [_words(branch) for branch in branches if not _choices(branch)]
    legal = " | ".join(dict.fromkeys([*choices, *words]))
    if kind == "missing" and (not path or not _has(_value(data, path[:-1]), path[-1])):
        return f"{name} is missing; expected {legal}"
    data = _value(data, path)
    return f"{name} is {_shown(data)}{did_you_mean(data, choices)}; expected {legal}"


def _value(data: Any, path: KeyPath) -> Any:
    for part in path:
        data = data[part] if _has(data, part) else None
    return data


def _shown(value: Any) -> str:
    if isinstance(value, str):
        text = repr(value)
    else:
        text = yaml.safe_dump(value, default_flow_style=True, width=10_000).removesuffix("...\n").strip()
    return text if len(text) <= 60 else text[:57] + "..."


def declared_at(schema: Schema, path: KeyPath, data: Any) -> list[Schema]:
    """The schemas for the value at `path`, by the kinds and schemes that the data choose."""
    branches = _branches(schema, data, schema)
    for part in path:
        data = data[part] if _has(data, part) else None
        children = [child for branch in branches if (child := _child(branch, part)) is not None]
        branches = [branch for child in children for branch in _branches(child, data, schema)]
    return branches


def _branches(node: Schema, data: Any, root: Schema) -> list[Schema]:
    """The alternatives of a node, with references resolved; only the one whose tag the data name, if they do."""
    while "$ref" in node:
        node = root["$defs"][node["$ref"].rsplit("/", 1)[1]]
    alternatives = node.get("anyOf") or node.get("oneOf")
    if alternatives is None:
        return [node]
    branches = [branch for alternative in alternatives for branch in _branches(alternative, data, root)]
    tag = node.get("discriminator", {}).get("propertyName")
    if tag is None or not isinstance(data, dict):
        return branches
    return [b for b in branches if data.get(tag) in _choices(b["properties"][tag])] or branches


def _child(branch: Schema, part: str | int) -> Schema | None:
    if isinstance(part, int):
        items: Sequence[Schema] = branch.get("prefixItems", [])
        return items[part] if part < len(items) else branch.get("items")
    extra = branch.get("additionalProperties")
    return branch.get("properties", {}).get(part) or (extra if isinstance(extra, dict) else None)


def _choices(branch: Schema) -> list[Any]:
    return branch.get("enum", [branch["const"]] if "const" in branch else [])


def _number(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:g}"


def _words(branch: Schema) -> str:
    """The legal values, if they are not a short list of choices."""
    kind = str(branch.get("type"))
    if kind in ("number", "integer"):
        text = "a whole number" if kind == "integer" else "a number"
        bounds = [("exclusiveMinimum", ">"), ("minimum", ">="), ("exclusiveMaximum", "<"), ("maximum", "<=")]
        limits = [f"{sign} {_number(branch[name])}" for name, sign in bounds if name in branch]
        return " ".join([text, " and ".join(limits)]).strip()
    if kind == "array" and "items" in branch:
        return f"a list of {branch.get('minItems', 0)} or more: {_words(branch['items'])}"
    if kind == "array":
        return f"a list of {branch.get('minItems')}: {branch.get('description')}"
    if kind == "object":
        return f"a group of keys: {', '.join(branch.get('properties', {})) or 'any'}"
    if kind == "string":
        if "pattern" in branch:
            return f"text of {branch['description']}"
        least, most = branch.get("minLength", 0), branch.get("maxLength")
        if most is None:
            return f"text of {least} or more characters" if least > 1 else "text that is not empty" if least else "text"
        return f"text of {least} to {most} characters"
    return {"boolean": "true | false"}.get(kind, kind)
