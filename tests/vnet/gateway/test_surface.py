"""The surface of `import zenoh` on virtual time is that of the installed Zenoh."""

import ast
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from tests.support.paths import ROOT
from vnet.gateway.emulated import REFUSED, zenoh_modules

MOST_REFUSED = 0.15
MODULES = zenoh_modules(
    cast(Any, SimpleNamespace(due=None)),
    cast(Any, SimpleNamespace(threads=None, environ={})),
)


def declared(module: str) -> Iterator[ast.stmt]:
    """Yield what a module's interface declares."""
    name = {"zenoh": "__init__"}.get(module, module.removeprefix("zenoh."))
    yield from ast.parse((Path(zenoh.__file__).parent / f"{name}.pyi").read_text()).body


def public(module: str) -> dict[str, ast.stmt]:
    """Return the public classes and functions of a module's interface."""
    kinds = ast.ClassDef | ast.FunctionDef
    return {each.name: each for each in declared(module) if isinstance(each, kinds) and each.name[0] != "_"}


def members(declared: ast.ClassDef) -> set[str]:
    """Return the methods, properties and constants of a class's interface."""
    found = set()
    for each in declared.body:
        targets = each.targets if isinstance(each, ast.Assign) else [getattr(each, "target", None)]
        found |= {target.id for target in targets if isinstance(target, ast.Name)}
        found |= {each.name} if isinstance(each, ast.FunctionDef) else set()
    return found


@pytest.mark.slow
@pytest.mark.parametrize("module", ["zenoh", "zenoh.ext", "zenoh.handlers", "zenoh.shm"])
def test_each_public_name_and_member_is_there(module: str) -> None:
    missing = []
    for name, each in public(module).items():
        own = getattr(MODULES[module], name, None)
        if own is None:
            missing.append(name)
        elif isinstance(each, ast.ClassDef) and name not in REFUSED:
            there = {name for base in own.__mro__ for name in (*vars(base), *getattr(base, "__annotations__", ()))}
            missing += [f"{name}.{member}" for member in sorted(members(each) - there)]
    assert missing == []


def test_few_names_are_refused_each_with_its_reason() -> None:
    names = {name for module in MODULES for name in public(module)}
    assert REFUSED.keys() <= names
    assert len(REFUSED) <= MOST_REFUSED * len(names)
    for name, reason in REFUSED.items():
        with pytest.raises(zenoh.ZError, match=f"zenoh.{name} is not available on virtual time: {reason}"):
            getattr(MODULES["zenoh"], name)()


def test_values_are_zenohs_own_wherever_python_can_construct_them() -> None:
    package: ModuleType = MODULES["zenoh"]
    assert package.KeyExpr("a/**").includes("a/b")
    assert isinstance(package.Config(), package.Config)
    assert isinstance(package.ZBytes(b"x"), zenoh.ZBytes)


def test_page_names_all_that_is_refused() -> None:
    page = (ROOT / "docs/how-to/zenoh.md").read_text().partition("Refused by name are")[2]
    assert {name for name in REFUSED if f"`{name}`" not in page} == set()
