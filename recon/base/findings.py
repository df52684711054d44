"""Findings: turns pydantic's errors about the values of a file into messages with the value and what is legal.

The messages are the same for configurations and for scenes. The legal keys and values come from the JSON schema.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, cast

from recon.base.registry import ADD_ONS, add_on_missing, did_you_mean
from recon.base.setting import Setting

KeyPath = tuple[str | int, ...]
Schema = Mapping[str, Any]
_OF_VALIDATOR = "Value error, "  # pydantic puts this before the message of our own validators
_BOUNDS = {
    "gt": "exclusiveMinimum",
    "ge": "minimum",
    "lt": "exclusiveMaximum",
    "le": "maximum",
}  # names in JSON schemas
_MANY = 2  # if a group has more unknown keys than this, the keys are assumed to belong to another kind of device


@dataclass(frozen=True)
class Fault:
    """An error in a file: the path of the key, and a message without a full stop."""

    key: KeyPath
    sentence: str


def faults_of(
    findings: Sequence[Mapping[str, Any]],
    data: Any,
    schema: Schema,
    where: str = "",
    former: Mapping[str, str] = MappingProxyType({}),
    advice: str = "",
) -> list[Fault]:
    """The errors in the order of the model's keys, one per key.

    Args:
        findings: the list from `pydantic.ValidationError.errors`.
        data: the plain values.
        schema: JSON schema of the legal values.
        where: prefix for the path of each key; "" at the top of a file.
        former: the path of each removed key, with a sentence that names the replacement.
        advice: sentence for a group that has the keys of another kind.
    """
    faults: dict[KeyPath, Fault] = {}
    for finding in findings:
        kind, message = finding["type"], str(finding["msg"]).removeprefix(_OF_VALIDATOR)
        missing = kind == "missing" and isinstance(finding["loc"][-1], str)  # not a missing item of a list
        path = _path(finding["loc"], data, missing)
        if kind.startswith("union_tag"):
            path = (*path, finding["ctx"]["discriminator"].strip("'"))
            missing = kind == "union_tag_not_found"
        name = ".".join(map(str, (where, *path) if where else path))
        key = path
        if kind == "value_error":
            words = message.split(maxsplit=1)
            key = (*path, *(words[0].rstrip(":,").split(".") if words else ()))
            sentence = f"{name}{'' if message.startswith('must ') else ':'} {message}" if name else message
        elif "[key]" in finding["loc"]:
            legal = "a whole number" if kind.startswith("int") else message.removeprefix("Input should be ")
            sentence = f"{name}: key must be {legal}"
        elif kind in ("extra_forbidden", "unexpected_keyword_argument"):
            sentence = _of_unknown(path, name, data, schema, former, advice)
        else:
            sentence = _of_value(path, name or "the configuration", data, schema, missing)
        if all(fault.sentence != sentence for fault in faults.values()):  # one message for all keys of a real device
            faults.setdefault(path, Fault(key, sentence))
    # pydantic may also report a list with a wrong item as too short
    lists = {path for path in faults if isinstance(_value(data, path), list)}
    items = {path[:-1] for path in faults if path}
    return [fault for path, fault in faults.items() if path not in lists & items]


def _of_unknown(path: KeyPath, name: str, data: Any, schema: Schema, former: Mapping[str, str], advice: str) -> str:
    """The message about a key that its group does not know."""
    if name in former:
        return f"{name} no longer exists; remove it. {former[name]}"
    if str(path[-1]) in ADD_ONS:
        return f"{name} {add_on_missing(str(path[-1]))}"
    keys = [key for branch in declared_at(schema, path[:-1], data) for key in branch.get("properties", {})]
    others = [key for key in _value(data, path[:-1]) if key not in keys]
    if advice and len(others) > _MANY:
        return (
            f"{name.rpartition('.')[0]}: remove the keys {', '.join(others)}, because they do not belong to the "
            f"stated kind. {advice}"
        )
    return f"{name} is not a known key{did_you_mean(path[-1], keys)}; legal keys in this section: {', '.join(keys)}"


def _of_value(path: KeyPath, name: str, data: Any, schema: Schema, missing: bool) -> str:
    """The message about a value that is missing or not legal."""
    branches = declared_at(schema, path, data)
    choices = [str(choice) for branch in branches for choice in _choices(branch)]
    words = [_words(branch) for branch in branches if not _choices(branch)]
    legal = " | ".join(dict.fromkeys([*choices, *words]))
    if missing and (not path or not _has(_value(data, path[:-1]), path[-1])):
        return f"{name} is missing; expected {legal}"
    value = _value(data, path)
    return f"{name} is {_shown(value)}{did_you_mean(value, choices)}; expected {legal}"


def _path(loc: Sequence[str | int], data: Any, missing: bool) -> KeyPath:
    """The key path in the file: pydantic's location without the names of union members."""
    path: list[str | int] = []
    for index, part in enumerate(loc):
        if _has(data, part):
            data = data[part]
            path.append(part)
        elif missing and index == len(loc) - 1:
            path.append(part)
    return tuple(path)


def _has(data: Any, part: str | int) -> bool:
    if isinstance(data, list):
        return isinstance(part, int) and part < len(data)
    return isinstance(data, dict) and part in data


def _value(data: Any, path: KeyPath) -> Any:
    for part in path:
        data = data[part] if _has(data, part) else None
    return data


def _shown(value: Any) -> str:
    """The value as YAML writes it on one line; text is in quotes."""
    text = repr(value) if isinstance(value, str) else _in_yaml(value)
    return text if len(text) <= 60 else text[:57] + "..."


def _in_yaml(value: Any) -> str:
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{_in_yaml(key)}: {_in_yaml(each)}' for key, each in value.items())}}}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(_in_yaml, value))}]"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value:+}".replace("+", "").replace("inf", ".inf").replace("nan", ".nan")
    return str(value).lower() if isinstance(value, bool) else "null" if value is None else str(value)


def declared_at(schema: Schema, path: KeyPath, data: Any) -> list[Schema]:
    """The schemas of the value at `path`. If a schema has alternatives, the data select them by their kind or
    scheme."""
    branches = _branches(schema, data, schema)
    for part in path:
        data = data[part] if _has(data, part) else None
        children = [child for branch in branches if (child := _child(branch, part)) is not None]
        branches = [branch for child in children for branch in _branches(child, data, schema)]
    return branches


def _branches(node: Schema, data: Any, root: Schema) -> list[Schema]:
    """The alternatives of a node, with references resolved. If the data name a tag, only the alternative with this
    tag."""
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
    if isinstance(part, int) and branch.get("type") == "array":
        items: Sequence[Schema] = branch.get("prefixItems", [])
        return items[part] if part < len(items) else branch.get("items")
    extra = branch.get("additionalProperties")
    return branch.get("properties", {}).get(part) or (extra if isinstance(extra, dict) else None)


def _choices(branch: Schema) -> list[Any]:
    return branch.get("enum", [branch["const"]] if "const" in branch else [])


def _words(branch: Schema) -> str:
    """A description of the legal values that are not a short list of choices."""
    kind = str(branch.get("type"))
    if kind in ("number", "integer"):
        text = "a whole number" if kind == "integer" else "a number"
        given = {name: float(branch[key]) for name, key in _BOUNDS.items() if key in branch}
        return f"{text} {Setting(**cast(Any, given)).words}".strip()
    if kind == "array" and "items" in branch:
        return f"a list of {branch.get('minItems', 0)} or more: {_words(branch['items'])}"
    if kind == "array":
        items = " and ".join(dict.fromkeys(map(_words, branch.get("prefixItems", ()))))
        return f"a list of {branch.get('minItems')}: {branch.get('description') or items}"
    if kind == "object":
        return f"a group of keys: {', '.join(branch.get('properties', {})) or 'any'}"
    if kind == "string":
        if "pattern" in branch:
            return f"text of {branch['description']}"
        least, most = branch.get("minLength", 0), branch.get("maxLength")
        return f"text of {least} to {most} characters" if most else "text that is not empty" if least else "text"
    return {"boolean": "true | false", "None": "any value"}.get(kind, kind)
