"""docs/reference/faults.md: every kind of fault and its parameters."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

from docs.generate.keys import key_table
from docs.generate.markdown import docstring, table
from docs.generate.markdown import page as whole_page
from emulator.scenario import faults

INTRODUCTION = """
A fault is a table `[[fault]]` in a scenario, the arguments of `vnet fault inject`, or those of `emu.fault(…)` in a
test. [faults.md](../faults.md) says how faults act, and [how to choose them](../how-to/faults.md) shows what one
writes.

```toml
[[fault]]
kind = "burst_loss"
at_s = 10.0
duration_s = 5.0
senders = { ids = ["v01", "v02"] }   # what these two send
receivers = { fraction = 0.5 }       # and half of all vehicles receive
loss_bad = 0.9
```
"""
COMMON = """
Faults of vehicles have `nodes` besides; those of links also have `senders` and `receivers`, and act on links with
an end among `nodes`, from one of `senders`, to one of `receivers`. Each of the three is a selector.
"""
SELECTORS = """
A selector is a table with one of these keys; without it, all vehicles are meant. So `nodes = { random = 3 }`, or
`--set nodes.random=3` at the command line.
"""
MISBEHAVIOUR = """
Named as in VeReMi (van der Heijden, Lukaseder, Kargl 2018; Kamel et al. 2020). The emulator does not know what
payloads mean: lies in them are a program, `agents.cooperative.attacker:main`, for some vehicles
([`[[program.exceptions]]`](scenario.md#programexceptions)).
"""
INFRASTRUCTURE = """
Live runs only; a simulation has neither. `router_restart` needs a router of its own, `vnet run --router separate`.
"""
GROUPS: dict[str, tuple[Any, str]] = {
    "Processes": (faults.ProcessFault, ""),
    "The network": (faults.Partition | faults.LinkFault | faults.Throttle | faults.Range | faults.Swizzle, ""),
    "GNSS receivers": (faults.GnssOutage | faults.GnssJump | faults.GnssRamp | faults.GnssFreeze, ""),
    "Clocks": (faults.ClockFault, ""),
    "Misbehaviour": (faults.ConstPosOffset | faults.RandomPos | faults.SenderFault, MISBEHAVIOUR),
    "Infrastructure": (faults.Infrastructure, INFRASTRUCTURE),
}
"""Titles, the kinds below them, and what is to be said of all of these."""
OF = {faults._LinkFault: "links", faults._NodeFault: "vehicles", faults._Fault: "the whole"}
TIMES = ("at_s", "duration_s")
SHARED = ("kind", *TIMES, "nodes", "senders", "receivers")

Kind = type[faults._Fault]


def page() -> str:
    """The whole page. Raises LookupError if a kind is in no group."""
    named = {_name(kind) for group, _ in GROUPS.values() for kind in get_args(group)}
    if missing := set(faults.KINDS) - named:
        raise LookupError(f"in no group of docs.generate.faults: {', '.join(sorted(missing))}")
    parts = [INTRODUCTION, "## What all have", key_table(faults._Fault), COMMON]
    parts += ["## Selectors", SELECTORS, key_table(faults.Selector)]
    for title, (group, said) in GROUPS.items():
        parts += [f"## {title}", said, *_group(get_args(group))]
    return whole_page("Faults", *parts)


def _group(kinds: tuple[Kind, ...]) -> Iterator[str]:
    """All kinds of a group in a table, and the keys of those that have some."""
    own = {kind: key_table(kind, without=_without(kind)) for kind in kinds}
    rows = ([_linked(kind, keys), _of(kind), docstring(kind)] for kind, keys in own.items())
    yield table(["kind", "of", "what happens"], rows)
    for kind in kinds:
        if own[kind]:
            yield f"### `{_name(kind)}`"
            yield own[kind]


def _name(kind: Kind) -> str:
    return str(get_args(kind.model_fields["kind"].annotation)[0])


def _linked(kind: Kind, keys: str) -> str:
    name = _name(kind)
    return f"[`{name}`](#{name.lower()})" if keys else f"`{name}`"


def _of(kind: Kind) -> str:
    return next(words for base, words in OF.items() if issubclass(kind, base))


def _without(kind: Kind) -> tuple[str, ...]:
    """What need not be said again: what is as for other kinds."""
    return tuple(name for name in SHARED if name not in TIMES or name not in kind.__annotations__)
