"""The base of all parts of a scenario, the bounds of their numbers, and the wording of what is wrong with one."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, TypeVar, get_args

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    TypeAdapter,
    ValidationError,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails

from vnet.errors import did_you_mean, printable, shown

T = TypeVar("T")

DAY_S = 86_400
"""No time in a scenario is longer, so that nanoseconds stay far within 64 bits."""
FAR_M = 1e9
"""No length in a scenario is larger, so that squares stay finite and millimetres mean something."""
WILD_M = 1e5
"""No standard deviation is larger, so that fixes stay near enough for frames to say."""
FAR_S = 1e11
"""Times of files, which may be seconds since 1970, are within ± three thousand years."""
Switch = Annotated[bool, Field(strict=True)]
"""True or false, and no word or number that stands for it."""

WORDS = {
    **dict.fromkeys(("model_type", "model_attributes_type", "dict_type"), "a table is needed"),
    **dict.fromkeys(("string_type", "string_unicode"), "text is needed"),
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float", "int_parsing_size"), "a whole number is needed"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number is needed"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false is needed"),
    **dict.fromkeys(("tuple_type", "list_type", "frozen_set_type", "set_type"), "a list is needed"),
    "path_type": "a path is needed",
    "finite_number": "a finite number is needed",
    "missing": "is missing",
    "greater_than": "must be greater than {gt}",
    "greater_than_equal": "must be greater than or equal to {ge}",
    "less_than": "must be less than {lt}",
    "less_than_equal": "must be less than or equal to {le}",
    "too_short": "{actual_length} entries, at least {min_length} are needed",
    "too_long": "{actual_length} entries, at most {max_length} are allowed",
    "string_too_short": "at least {min_length} characters are needed",
    "string_too_long": "at most {max_length} characters are allowed",
    "string_pattern_mismatch": "must match {pattern}",
}
"""Words for what is allowed where a value is of a wrong type or out of bounds, by pydantic's type of error."""


_ALTERNATIVE = re.compile(r"constrained-\w+|(function-[\w-]+|tuple|list|dict|union)\[.*")
"""Names of pydantic's for one of several types that a key's value may have; they are no part of the key."""


class Section(BaseModel):
    """Common behaviour of all sections: immutable, and no key is ignored silently.

    The docstring below a key is its description, from which docs/reference is made; pydantic would read the source
    of every class at every start to know it.
    """

    kinds: ClassVar[Mapping[str, type[Section]]] = {}
    """The classes of a section that has several kinds, told apart by the key `kind`."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False, defer_build=True)

    @model_validator(mode="wrap")
    @classmethod
    def _numbers_are_numbers(cls, given: Any, validate: ModelWrapValidatorHandler[Any]) -> Any:
        """Refuse true, "4" and 4.0 for 4, which pydantic takes."""
        made = validate(given)
        for key in given if isinstance(given, dict) else ():
            if key in made.model_fields_set and (problem := _of_another_type(given[key], getattr(made, key))):
                wrong = InitErrorDetails(type=problem, loc=(key,), input=given[key])
                raise ValidationError.from_exception_data(cls.__name__, [wrong])
        return made


def _of_another_type(given: Any, made: Any) -> Literal["", "int_type", "float_type"]:
    """Return pydantic's type of error if a number was made of something else; "" if not."""
    if isinstance(made, tuple) and isinstance(given, list | tuple):
        return next(filter(None, map(_of_another_type, given, made)), "")
    if type(made) is int and isinstance(given, bool | str | float):
        return "int_type"
    return "float_type" if type(made) is float and isinstance(given, bool | str) else ""


_validator: Callable[[Any], TypeAdapter[Any]] = cache(TypeAdapter)
"""The validator of a type, which takes some milliseconds to make: it is made when it is needed."""


def validated(of: type[T], data: object, strict: bool | None = None) -> T:
    """Return plain data, as of JSON, as a value `of` this type. Raises ValidationError."""
    value: T = _validator(of).validate_python(data, strict=strict)
    return value


def first_problem(error: ValidationError, of: type[Any]) -> str:
    """Return the first problem of a value `of` this type, as `key = value: what is allowed`."""
    problems = error.errors()
    # A key that is misspelt is unknown, and the one that was meant may be missing.
    problem = next((each for each in problems if each["type"] == "extra_forbidden"), problems[0])
    path = problem["loc"]
    if problem["type"] != "extra_forbidden":
        path = tuple(part for part in path if not _ALTERNATIVE.fullmatch(str(part)))
    keys, sections = _followed(of, path)
    key = printable(".".join(str(part) for part in keys) or "it")
    before = f"{key}: " if path else ""
    if problem["type"] == "extra_forbidden":
        allowed = sorted({name for section in _followed(of, path[:-1])[1] for name in section.model_fields})
        return f"{key}: unknown key{did_you_mean(path[-1], allowed)}; allowed here: {', '.join(allowed)}"
    if problem["type"] == "union_tag_not_found":
        return f"{before}a kind is needed"
    if problem["type"] == "union_tag_invalid":
        kinds = sorted(problem["ctx"]["expected_tags"].replace("'", "").split(", "))
        tag = problem["ctx"]["tag"]
        return f"{before}kind = {shown(tag)}{did_you_mean(tag, kinds)}: must be one of {', '.join(kinds)}"
    message = _worded(problem)
    is_section = not any(path[-1:] == (name,) for section in sections for name in section.model_fields)
    if isinstance(problem["input"], dict) and message == "a list is needed" and is_section:
        return f"{key}: a list of tables is needed: write [[{key}]] in place of [{key}]"
    if problem["type"] == "missing":
        return f"{key}: {message}"
    if _is_long(problem["input"]):  # a whole section is wrong, or is not a section's kind of value
        return f"{key}: {message}" if path else message
    return f"{key} = {shown(problem['input'])}: {message}"


def _is_long(given: Any) -> bool:
    """Return whether a value is a section, or a list of them: too long for a line."""
    return isinstance(given, dict) or (isinstance(given, (list, tuple)) and any(isinstance(x, dict) for x in given))


def _worded(problem: ErrorDetails) -> str:
    """Return what is allowed, in words for people; validators of vnet's own have said it themselves."""
    kind, given = problem["type"], problem.get("ctx", {})
    if kind == "literal_error":
        known = given["expected"].replace("'", "").replace(" or ", ", ").split(", ")
        return f"must be {given['expected']}{did_you_mean(problem['input'], known)}"
    if kind in WORDS:
        return WORDS[kind].format_map({key: f"{v:.12g}" if isinstance(v, float) else v for key, v in given.items()})
    message = problem["msg"].removeprefix("Value error, ").removeprefix("Input should be ")
    return message[:1].lower() + message[1:]


def _followed(of: type[Any], path: Sequence[int | str]) -> tuple[list[int | str], list[type[BaseModel]]]:
    """Return the keys of a `path`, without the kinds that pydantic puts in, and the sections at its end.

    Numbers are indices of lists. Names that are neither a key nor a kind are the user's own, of a table such as
    `world.sensor`.
    """
    keys, models = list[int | str](), list(_sections_in(of))
    for name in path:
        kinds = [m for m in models if "kind" in m.model_fields] if len(models) > 1 else []
        by_kind = [m for m in kinds if name in get_args(m.model_fields["kind"].annotation)]
        if not by_kind or not keys or isinstance(keys[-1], int):  # of a fault the kind tells which it is
            keys.append(name)
        if not isinstance(name, int):
            fields = [m.model_fields[name] for m in models if name in m.model_fields]
            models = by_kind or [m for f in fields for m in _sections_in(f.annotation)] or models
    return keys, models


def _sections_in(annotation: Any) -> Iterator[type[BaseModel]]:
    """Yield the sections that an annotation names, and all kinds of those that have several."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
        if issubclass(annotation, Section):
            yield from annotation.kinds.values()
    for part in get_args(annotation):
        yield from _sections_in(part)


def must_grow(name: str, values: Sequence[float]) -> None:
    """Require each value to be greater than the one before. Raises ValueError that names the first that is not."""
    for index, (before, value) in enumerate(pairwise(values), 1):
        if value <= before:
            raise ValueError(f"{name}.{index} = {value:g}: must be greater than the value before it, {before:g}")


def must_not_grow(name: str, values: Sequence[float]) -> None:
    """Require each value to be at most the one before. Raises ValueError that names the first that is not."""
    for index, (before, value) in enumerate(pairwise(values), 1):
        if value > before:
            raise ValueError(f"{name}.{index} = {value:g}: must be at most the value before it, {before:g}")
