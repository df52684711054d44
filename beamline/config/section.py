"""Section: a frozen group of configuration keys; unknown keys are refused."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ConfigDict, create_model, model_validator


class Section(BaseModel):
    """A frozen group of keys. It refuses unknown keys, and `yes` for a number."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _no_truth_for_numbers(cls, data: Any) -> Any:
        for name, field in cls.model_fields.items():
            if isinstance(data, dict) and isinstance(data.get(name), bool) and field.annotation is not bool:
                value = str(data[name]).lower()
                raise ValueError(f"{name} is {value} (YAML reads yes, no, on and off as true and false)")
        return data


def section_of(name: str, base: type[Section], keys: Mapping[str, Any], doc: str | None = None) -> Any:
    """A section with more keys, (type, default) each, as pydantic.create_model takes a field.

    Their docstrings are not looked for: pydantic would search every loaded module, which takes most of the import.
    """
    unread = {"use_attribute_docstrings": False}
    return create_model(name, __base__=base, __doc__=doc, __cls_kwargs__=unread, **keys)
