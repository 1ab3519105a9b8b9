"""The surface of `import zenoh` on virtual time is that of the installed Zenoh."""

import ast
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from tests.support.paths import ROOT
from tests.vnet.gateway.conftest import Drive, log
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


ARGUMENTS = """
    ext.RecoveryConfig(periodic_queries=1.0)
    ext.RecoveryConfig(periodic_queries=SECOND)
    ext.RecoveryConfig(heartbeat=False)
    ext.MissDetectionConfig(heartbeat=SECOND)
    ext.MissDetectionConfig(heartbeat=-1.0)
    ext.MissDetectionConfig(heartbeat=0)
    ext.MissDetectionConfig(sporadic_heartbeat="1")
    ext.CacheConfig(-1)
    ext.CacheConfig("3")
    ext.CacheConfig(3)
    ext.HistoryConfig(max_age=SECOND)
    ext.HistoryConfig(max_age=1, detect_late_publishers=True)
    ext.RepliesConfig(priority=3)
    handlers.RingChannel(-1)
    handlers.FifoChannel(0)
    session.get("a", timeout=-1.0)
    session.get("a", timeout=float("nan"))
    session.get("a", timeout=SECOND)
    session.get("a", timeout=1, allowed_destination="any")
    session.get("a", timeout=0)
    session.declare_querier("a", timeout=SECOND)
    session.declare_queryable("a", complete=1)
    session.declare_queryable("a", complete=np.bool_(1))
    session.declare_subscriber("a", allowed_origin=3)
    session.declare_publisher("a", reliability=True)
    session.liveliness().get("a", timeout=SECOND)
    session.liveliness().declare_subscriber("a", history=1)
"""
NAMES = """
from datetime import timedelta
import numpy as np
from zenoh import ext, handlers
SECOND = timedelta(seconds=1)
"""


def attempts() -> str:
    """Return a program that collects in `answers` what becomes of each of these calls at a `session`."""
    return f"""
answers = []
for call in {ARGUMENTS.split(chr(10))[1:-1]!r}:
    try:
        eval(call.strip())
    except Exception as error:
        answers.append(f"{{call.strip()}}: {{type(error).__name__}}")
"""


@pytest.mark.slow
def test_arguments_are_refused_as_by_zenoh_itself(drive: Drive) -> None:
    config = zenoh.Config()
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled"):
        config.insert_json5(key, "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        there: dict[str, Any] = {"session": session}
        exec(NAMES + attempts(), there)
    run = drive(f"import zenoh\n{NAMES}session = zenoh.open(zenoh.Config()){attempts()}print(*answers, sep='\\n')")
    assert log(run)[:-1] == there["answers"] != []
