"""Options of a program: `[program.options]` of a scenario as a typed structure, or an error of one line."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, Literal, TypeVar, get_args, get_origin

import msgspec
from msgspec import inspect

from vnet.errors import ProgramError, did_you_mean, shown

S = TypeVar("S", bound=msgspec.Struct)


def parse(options: Mapping[str, Any], kind: type[S], renamed: Mapping[str, str] | None = None) -> S:
    """Convert options to a structure of the class `kind`; its field types and their bounds say what is allowed.

    `renamed` has the new names of keys that had another. Raises ProgramError, in one line, with the key, its value
    and what is allowed.
    """
    fields = _fields_of(kind)
    values = {}
    for key, value in options.items():
        if key not in fields:
            raise ProgramError(f"program.options.{key}: {_unknown(key, fields, renamed or {})}")
        values[key] = _convert(key, value, fields[key].type)
    return kind(**values)


@cache  # asked for each vehicle, and a millisecond each time
def _fields_of(kind: type[msgspec.Struct]) -> Mapping[str, msgspec.structs.FieldInfo]:
    """Return the fields of a class by name."""
    return {field.name: field for field in msgspec.structs.fields(kind)}


def refuse(key: str, value: object, expected: str) -> ProgramError:
    """Return the error for a value that is not allowed."""
    return ProgramError(f"program.options.{key} = {shown(value)}: {expected}")


def _unknown(key: str, known: Mapping[str, object], renamed: Mapping[str, str]) -> str:
    if key in renamed:
        return f"renamed; use {renamed[key]}"
    return f"unknown{did_you_mean(key, known)}; allowed: {', '.join(sorted(known))}"


def _convert(key: str, value: object, kind: Any) -> object:
    """Convert the value of one key; that of a table entry by entry, so that an error names the entry."""
    if get_origin(kind) is dict and isinstance(value, dict):
        return {name: _convert(f"{key}.{name}", entry, get_args(kind)[1]) for name, entry in value.items()}
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        if get_origin(kind) is Literal:
            expected = f"one of {', '.join(get_args(kind))} expected{did_you_mean(value, get_args(kind))}"
        else:
            expected = f"{_described(inspect.type_info(kind))} expected"
        raise refuse(key, value, expected) from error


def _described(info: inspect.Type) -> str:
    """Describe what a type allows: "a whole number from 1 to 1000"."""
    match info:
        case inspect.BoolType():
            return "true or false"
        case inspect.IntType():
            return f"a whole number{_range(info)}"
        case inspect.FloatType():
            return f"a number{_range(info)}"
        case inspect.TupleType(items):
            return f"a list of {len(items)} (each {_described(items[0])})"
        case inspect.ListType(item):
            return f"a list (each {_described(item)})"
        case inspect.DictType(_, value):
            return f"a table (each {_described(value)})"
        case _:
            return "text"


def _range(info: inspect.IntType | inspect.FloatType) -> str:
    if info.ge is not None and info.le is not None:
        return f" from {info.ge:g} to {info.le:g}"
    if info.gt is not None:
        return f" above {info.gt:g}"
    return ""
