"""The surface of `import zenoh` on virtual time is that of the installed Zenoh."""

import ast
import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any, cast

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from tests.support.paths import ROOT
from tests.vnet.gateway.conftest import Drive, events, log, printed
from vnet.gateway.emulated import REFUSED, zenoh_modules

MOST_REFUSED = 0.15
MODULES = zenoh_modules(cast(Any, SimpleNamespace(due=None)), cast(Any, SimpleNamespace(threads=None, environ={})))


def declared(module: str) -> Iterator[ast.stmt]:
    """Yield what a module's interface declares."""
    name = {"zenoh": "__init__", "zenoh.zenoh": "__init__"}.get(module, module.removeprefix("zenoh."))
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
            told = {name for base in own.__mro__ for name in getattr(base, "__annotations__", ())}
            missing += [f"{name}.{each}" for each in sorted(members(each) - told) if not hasattr(own, each)]
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


@given(st.dictionaries(st.text("ab"), st.text("ab")))
def test_parameters_have_the_order_of_their_dict(items: dict[str, str]) -> None:
    package: ModuleType = MODULES["zenoh"]
    parameters = package.Parameters(items)
    assert isinstance(parameters, package.Parameters)
    assert list(parameters) == [item for item in items.items() if item[0]]
    assert sorted(str(parameters).split(";")) == sorted(str(zenoh.Parameters(items)).split(";"))
    assert str(package.Selector("k", items).parameters) == str(parameters)


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
import zenoh
from zenoh import ext, handlers
SECOND = timedelta(seconds=1)
"""
AT = {
    "CacheConfig": "ext.CacheConfig",
    "CancellationToken": "zenoh.CancellationToken",
    "FifoChannel": "handlers.FifoChannel",
    "HistoryConfig": "ext.HistoryConfig",
    "Liveliness": "session.liveliness()",
    "MissDetectionConfig": "ext.MissDetectionConfig",
    "Publisher": "session.declare_publisher('a')",
    "Querier": "session.declare_querier('a')",
    "Query": "asked[0]",
    "RecoveryConfig": "ext.RecoveryConfig",
    "RepliesConfig": "ext.RepliesConfig",
    "RingChannel": "handlers.RingChannel",
    "Session": "session",
}
"""Expression for an object of each class, or for the class, in a program."""
VALUES = [
    *("3", "-1", "1e30", "1e400", "float('nan')", "'x'", "object()", "True", "[]", "()", "{}", "2**70", "1.5"),
    *("SECOND", "None", "zenoh.Priority.DATA"),
]
GIVEN = {"key_expr": "'a'", "selector": "'a'", "payload": "'x'", "capacity": "3", "session": "session"}
"""Arguments that a call needs."""


def calls_of(target: str, function: ast.FunctionDef) -> list[str]:
    """Return calls of a function with each value for each of its arguments, and with one that it does not have."""
    names = [each.arg for each in function.args.args if each.arg not in ("self", "cls")]
    needed = names[: len(names) - len(function.args.defaults)]
    given = {name: GIVEN.get(name, "None") for name in needed}
    named = [each.arg for each in function.args.kwonlyargs if each.arg != "timestamp_instrumentation"]
    tried = [*((name, value) for name in [*needed, *named] for value in VALUES), ("nonsense", "1")]
    return [
        f"{target}({', '.join(f'{each}={it}' for each, it in {**given, name: value}.items())})"
        for name, value in tried
    ]


def generated() -> list[str]:
    """Return right and wrong calls of the functions in the stubs of the installed Zenoh."""
    calls = []
    for module in ("__init__", "ext", "handlers"):
        tree = ast.parse(Path(zenoh.__file__).with_name(f"{module}.pyi").read_text())
        for each in tree.body:
            if isinstance(each, ast.FunctionDef) and each.name.startswith("declare_advanced"):
                calls += calls_of(f"ext.{each.name}", each)
            if not isinstance(each, ast.ClassDef) or each.name not in AT:
                continue
            for method in each.body:
                if not isinstance(method, ast.FunctionDef) or method.name in ("close", "undeclare", "__exit__"):
                    continue
                if method.name in ("__new__", "__init__"):
                    calls += calls_of(AT[each.name], method)
                elif method.name.startswith(("declare", "get", "put", "delete", "reply")):
                    calls += calls_of(f"{AT[each.name]}.{method.name}", method)
    return [call.replace("key_expr='a'", "key_expr='asked'") if "asked" in call else call for call in calls]


def attempts() -> str:
    """Return a program that collects in `answers` what becomes of each of these calls at a `session`."""
    return f"""
queryable, pending = session.declare_queryable("asked"), session.get("asked", timeout=60)
asked, answers = [queryable.recv()], []
for call in {[*map(str.strip, ARGUMENTS.split(chr(10))[1:-1]), *generated()]!r}:
    try:
        eval(call)
    except Exception as error:
        answers.append(f"{{call}}: {{type(error).__name__}}")
"""


@pytest.mark.slow
def test_arguments_are_refused_as_by_zenoh_itself(drive: Drive) -> None:
    config = zenoh.Config()
    for key in ("scouting/multicast/enabled", "scouting/gossip/enabled"):
        config.insert_json5(key, "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("timestamping/enabled", "true")
    with zenoh.open(config) as session:
        there: dict[str, Any] = {"session": session}
        with warnings.catch_warnings(action="ignore"):  # which pytest makes errors of
            exec(NAMES + attempts(), there)
    opened = (
        'config = zenoh.Config()\nconfig.insert_json5("timestamping/enabled", "true")\nsession = zenoh.open(config)'
    )
    run = drive(f"{NAMES}{opened}{attempts()}print(*answers, sep='\\n')")
    assert printed(run) == there["answers"] != []


@pytest.mark.slow
def test_an_option_that_is_refused_is_refused_by_its_name(drive: Drive) -> None:
    run = drive("""
        import zenoh
        session = zenoh.open(zenoh.Config())
        points = zenoh.TimestampInstrumentationBuilder().set_send(True).build()
        try:
            session.put("a", b"", timestamp_instrumentation=points)
        except zenoh.ZError as error:
            print(error)
        """)
    assert log(run)[0].startswith("timestamp_instrumentation is not available on virtual time")


@pytest.mark.slow
@pytest.mark.parametrize(
    "call",
    [
        'session.declare_querier("a", encoding="text/plain")',
        'session.declare_querier("a").get(priority=zenoh.Priority.DATA)',
        'session.delete("a", encoding="text/plain")',
    ],
)
def test_an_option_that_zenoh_does_not_take_is_refused(drive: Drive, call: str) -> None:
    run = drive(f"import zenoh\nsession = zenoh.open(zenoh.Config())\n{call}\n")
    (crash,) = events(run, "crashed")
    assert crash["error"].startswith("TypeError") and crash["error"].endswith("'")
