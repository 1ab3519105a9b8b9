"""What all parts of a scenario have in common, and how it is said what is wrong with one."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from vnet.errors import did_you_mean, printable, shown


class Section(BaseModel):
    """Common behaviour of all sections: immutable, and no key is ignored in silence.

    The docstring below a key is its description, from which docs/reference is made.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, use_attribute_docstrings=True)


def first_problem(error: ValidationError, of: type[BaseModel] | TypeAdapter[Any]) -> str:
    """The first of pydantic's complaints about a value `of` this kind, as `key = value: what is allowed`."""
    problems = error.errors()
    # A key that is misspelt is unknown, and the one that was meant may be missing.
    problem = next((each for each in problems if each["type"] == "extra_forbidden"), problems[0])
    place = problem["loc"]
    key = printable(".".join(str(part) for part in place) or "it")
    before = f"{key}: " if place else ""
    if problem["type"] == "extra_forbidden":
        allowed = _allowed_keys(of, place[:-1])
        return f"{key}: unknown key{did_you_mean(place[-1], allowed)}; allowed here: {', '.join(allowed)}"
    if problem["type"] == "union_tag_not_found":
        return f"{before}a kind is needed"
    if problem["type"] == "union_tag_invalid":
        kinds = sorted(problem["ctx"]["expected_tags"].replace("'", "").split(", "))
        tag = problem["ctx"]["tag"]
        return f"{before}kind = {shown(tag)}{did_you_mean(tag, kinds)}: must be one of {', '.join(kinds)}"
    message = problem["msg"].removeprefix("Value error, ")
    message = message[0].lower() + message[1:]
    if isinstance(problem["input"], dict):  # a whole section is wrong, or is not a section's kind of value
        return f"{key}: {message}" if place else message
    return f"{key} = {shown(problem['input'])}: {message}"


def _allowed_keys(of: type[BaseModel] | TypeAdapter[Any], place: tuple[int | str, ...]) -> list[str]:
    """The keys of the section at `place`, where a number is a place in a list and a kind stands for its model."""
    models = list(_models(of))
    for name in place:
        if isinstance(name, int):
            continue
        kinds = [m for m in models if "kind" in m.model_fields]
        by_kind = [m for m in kinds if name in get_args(m.model_fields["kind"].annotation)]
        fields = [m.model_fields[name] for m in models if name in m.model_fields]
        models = by_kind or [m for f in fields for m in _models(f.annotation)]
    return sorted({key for model in models for key in model.model_fields})


def _models(annotation: Any) -> Iterator[type[BaseModel]]:
    """All models that an annotation speaks of."""
    if isinstance(annotation, TypeAdapter):
        annotation = annotation._type
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models(part)
