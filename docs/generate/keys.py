"""The keys of a section of the scenario, as a table: from the JSON schema that pydantic makes of its model."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterator
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
from pydantic import BaseModel

from docs.generate.markdown import attribute_docstrings, table
from vnet.units import unit_of

HEADER = ("key", "type", "default", "unit", "allowed", "what")
_TYPES = {
    "integer": "whole number",
    "number": "number",
    "boolean": "true or false",
    "object": "table",
    "string": "text",
}
_BOUNDS = {
    "exclusiveMinimum": "> {}",
    "minimum": "≥ {}",
    "exclusiveMaximum": "< {}",
    "maximum": "≤ {}",
    "minItems": "at least {}",
    "pattern": "`{}`",
}


def key_table(model: type[BaseModel], without: Collection[str] = ()) -> str:
    """The keys of `model`, but for those that are sections themselves or that are named; "" if none is left."""
    return table(HEADER, key_rows(model, without))


def key_rows(model: type[BaseModel], without: Collection[str] = ()) -> list[list[str]]:
    """The rows of `key_table`."""
    schema = model.model_json_schema()
    required = schema.get("required", ())
    said = key_docstrings(model)
    rows = []
    for name, key in schema.get("properties", {}).items():
        if name not in without and name not in subsections(model):
            if name not in said:
                raise LookupError(f"{model.__name__}.{name} has no docstring")
            rows.append(_row(name, {**key, "description": said[name]}, name in required))
    return rows


def key_docstrings(model: type[BaseModel]) -> dict[str, str]:
    """The docstrings below the keys of a section, and of the sections that it derives from."""
    said: dict[str, str] = {}
    for of in reversed(model.__mro__):
        if issubclass(of, BaseModel) and of is not BaseModel:
            said |= attribute_docstrings(of)
    return said


def option_table(options: type[msgspec.Struct]) -> str:
    """The options of a program, from the JSON schema that msgspec makes of their structure and their docstrings."""
    (schema,), components = msgspec.json.schema_components([options])
    properties = components[schema["$ref"].rpartition("/")[2]]["properties"]
    said = attribute_docstrings(options)
    rows = [_row(name, {**key, "description": said[name]}, False) for name, key in properties.items()]
    return table(HEADER, rows)


def _row(name: str, key: dict[str, Any], required: bool) -> list[str]:
    default = "required" if required else _default(key)
    return [f"`{name}`", _type(key), default, unit_of(name), _allowed(key), key["description"]]


def subsections(model: type[BaseModel]) -> dict[str, list[type[BaseModel]]]:
    """The keys of a model that are models themselves, or one of several; without selectors, which take one line."""
    found = {name: list(_models(field.annotation)) for name, field in model.model_fields.items()}
    return {name: kinds for name, kinds in found.items() if kinds and kinds[0].__name__ != "Selector"}


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """The models of an annotation that is a model, or a union of some or of one and None."""
    if isinstance(annotation, type):
        if issubclass(annotation, BaseModel):
            yield annotation
    elif get_origin(annotation) in (Annotated, Union, UnionType):
        for part in get_args(annotation):
            yield from _models(part)


def _type(key: dict[str, Any], many: bool = False) -> str:
    """Kind of value that a key takes, in words; `many` for a list of them."""
    if "$ref" in key:
        return "[selector](faults.md#selectors)"
    if "anyOf" in key:
        return " or ".join(_type(part) for part in key["anyOf"] if part["type"] != "null")
    if "enum" in key:
        return " or ".join(f"`{json.dumps(value)}`" for value in key["enum"])
    if "prefixItems" in key:
        return f"[{', '.join(_type(part) for part in key['prefixItems'])}]"
    if key["type"] == "array":
        return f"{'lists' if many else 'list'} of {_type(key['items'], many=True)}"
    name = "file name" if key.get("format") == "path" else _TYPES[key["type"]]
    return f"{name}s" if many else name


def _default(key: dict[str, Any]) -> str:
    value = key.get("default")
    if "$ref" in key:
        return "all"
    if value is None or value in ([], {}):
        return "none"
    return f"`{number(value)}`" if isinstance(value, (int, float)) else f"`{json.dumps(value)}`"


def _allowed(key: dict[str, Any]) -> str:
    """The bounds of a key, in words, and those of each of its values if it takes a list."""
    each = ", ".join(_bounds(key.get("items") or key.get("prefixItems", [{}])[0]))
    return ", ".join([*_bounds(key), *([f"each {each}"] if each else [])])


def _bounds(key: dict[str, Any]) -> Iterator[str]:
    for part in [key, *key.get("anyOf", ())]:
        for name, words in _BOUNDS.items():
            if name in part and (name != "minItems" or "prefixItems" not in part):
                yield words.format(number(part[name]))


def number(value: object) -> str:
    """A number as one would write it: 86400 and 0.1, but 1e9; anything else as it is."""
    if isinstance(value, bool):
        return str(value).lower()
    if not isinstance(value, (int, float)):
        return str(value)
    if value == 2**63:
        return "2⁶³"
    if value == int(value) and abs(value) < 1e7:
        return str(int(value))
    digits, e, power = f"{value:g}".partition("e")
    return f"{digits}{e}{int(power)}" if e else digits
