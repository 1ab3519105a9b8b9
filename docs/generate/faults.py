"""docs/reference/faults.md: every kind of fault and its parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from docs.generate.keys import HEADER, key_rows, key_table
from docs.generate.markdown import docstring, table
from docs.generate.markdown import page as whole_page
from emulator.scenario.faults import KINDS, Drawn, Fault, Selector
from emulator.testing.campaign_plan import MOST_FAULTS, simulated_kinds

INTRODUCTION = """
A fault is a table `[[fault]]` in a scenario, the arguments of `vnet fault inject`, or those of `emu.fault(…)` in a
test. [faults.md](../faults.md) shows how to choose faults, and defines how they act.

```toml
[[fault]]
kind = "burst_loss"
at_s = 10.0
duration_s = 5.0
senders = ["v01", "v02"]             # what these two send
receivers = { fraction = 0.5 }       # and half of all vehicles receive
loss_bad = 0.9
```

The tables below have a row in bold for each kind, and below it a row for each key of its own.
"""
COMMON = """
Faults of vehicles also have `nodes`; those of links also have `senders` and `receivers`, and act on links with an
end among `nodes`, from one of `senders`, to one of `receivers`. Each of the three is a selector.
"""
SELECTORS = """
A selector is a table with one of these keys, or a list of ids: `nodes = { count = 3 }`, `nodes = ["v01", "v02"]`,
or `--set nodes.count=3` at the command line. Without it the fault selects all vehicles.
"""
MISBEHAVIOUR = """
Names are those of VeReMi (van der Heijden, Lukaseder, Kargl 2018; Kamel et al. 2020). The emulator does not
interpret payloads: [lies in them](../faults.md#in-a-scenario) are a program for some vehicles
([`[[program.exceptions]]`](scenario.md#program)).
"""
INFRASTRUCTURE = """
For live runs only. `router_restart` needs `vnet run --router separate`, unless programs speak Zenoh.
"""
DRAWN = f"""
`vnet campaign`, and the strategy `faults` of property tests, draw faults of these kinds. A run of a campaign has
one to {MOST_FAULTS} of them. Weights are relative. A fault starts at any hundredth of a second, lasts any number of
tenths that fits, and ends `run.settle_s` before the end. Keys without a range above keep their defaults. All
numbers of a range are equally likely; a pair of numbers is two draws. `vnet campaign --draw
delay.delay_ms=1..2000` draws from another range, in the same steps; it may be repeated.
"""
RULES = """
[faults.md](../faults.md#rules-of-your-own) defines rules. They are part of a scenario, or of a test as
`emu.rule(…)`; a running emulator accepts none.
"""
NOTES = {"Misbehaviour": MISBEHAVIOUR, "Infrastructure": INFRASTRUCTURE, "Rules of your own": RULES}
"""Notes below the titles of chapters."""
SHARED = ("nodes", "senders", "receivers")
"""Selectors, which the introduction describes."""


def page() -> str:
    """Return the whole page: a chapter for each `chapter` that a kind names, in the order of the kinds."""
    parts = [INTRODUCTION, "## Common keys", key_table(Fault, without=("kind",)), COMMON]
    parts += ["## Selectors", SELECTORS, key_table(Selector)]
    for title in dict.fromkeys(kind.chapter for kind in KINDS.values()):
        chapter = {name: kind for name, kind in KINDS.items() if kind.chapter == title}
        parts += [f"## {title}", NOTES.get(title, ""), *_chapter(chapter)]
    parts += ["## What a campaign draws", DRAWN, table(["kinds with their weights", "target"], _drawn())]
    return whole_page("Faults", *parts)


def _drawn() -> Iterator[Sequence[str]]:
    """Yield a row for each target: the kinds that a campaign aims at it, from their declarations."""
    kinds_of: dict[str, list[str]] = {}
    for name in simulated_kinds():
        target = docstring(KINDS[name].draw_target).removeprefix("Draw ").rstrip(".")
        kinds_of.setdefault(target, []).append(f"`{name}` {KINDS[name].campaign_weight}")
    for target, names in kinds_of.items():
        yield ", ".join(names), target


def _range(law: Drawn) -> str:
    """Return the range of a parameter in words."""
    low, high = law.bounds
    return f" (a campaign: {low:g} to {high:g} in steps of {law.step:g})"


def _chapter(kinds: Mapping[str, type[Fault]]) -> list[str]:
    """Return the table of all kinds of a chapter: a row for each, and below it one for each key of its own."""
    rows: list[list[str]] = []
    for name, kind in kinds.items():
        drawn = kind.drawn_ranges()
        rows.append([f"**`{name}`**", kind.acts_on, "", "", "", docstring(kind)])
        for key, *cells, text in key_rows(kind, without=_without(kind)):
            rows.append([key, *cells, text + (_range(drawn[key.strip("`")]) if key.strip("`") in drawn else "")])
    return [table(("kind, key", "acts on, type", *HEADER[2:]), rows)]


def _without(kind: type[Fault]) -> tuple[str, ...]:
    """The keys that need not be repeated: selectors, and those that every fault has with the same default."""
    common = Fault.model_fields
    same = [name for name in common if kind.model_fields[name].default == common[name].default]
    return ("kind", *SHARED, *same)
