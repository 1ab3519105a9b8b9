"""Faults as data: what may be written down, what is said where it may not, and that it survives being written."""

import json
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from emulator.fault_plan import FaultPlan, Nodes
from emulator.scenario import faults
from emulator.scenario.faults import KINDS, Fault, parse_fault
from emulator.scenario.loading import dump_scenario, load_scenario, parse_recorded_scenario
from emulator.scenario.scenario import Scenario
from vnet.errors import ScenarioError

REQUIRED: dict[str, dict[str, Any]] = {
    "loss": {"probability": 0.5},
    "delay": {"delay_ms": 20.0},
    "jitter": {"jitter_ms": 30.0},
    "throttle": {"bitrate_mbps": 0.1},
    "range": {"range_m": 500.0},
    "gnss_jump": {"offset_m": (3.0, -4.0)},
    "gnss_ramp": {"rate_m_s": (1.0, 0.5)},
    "skew": {"offset_ms": 250.0},
    "drift": {"rate_ppm": 300.0},
    "custom": {"rule": "emulator.nothing:nobody"},
    "custom_sender": {"rule": "emulator.nothing:nobody"},
}
"""Parameters that a kind requires."""
DEFAULTS: dict[str, dict[str, Any]] = {
    "partition": {"groups": "halves"},
    "burst_loss": {"enter": 0.05, "leave": 0.3, "loss_bad": 1.0, "loss_good": 0.0},
    "reorder": {"probability": 0.2, "delay_ms": 150.0},
    "duplicate": {"probability": 0.2, "copies": 1, "delay_ms": 10.0},
    "corrupt": {"probability": 0.2, "flips": 1},
    "swizzle": {"over_s": None},
    "ConstPosOffset": {"offset_m": (50.0, 0.0)},
    "RandomPos": {"radius_m": 300.0},
    "DataReplay": {"age_s": 1.0},
    "StaleMessages": {"age_s": 1.0},
    "DoS": {"factor": 10},
    "Sybil": {"ghosts": 3},
    "custom": {"name": None, "options": {}},
    "custom_sender": {"name": None, "options": {}},
    "emulator_restart": {"down_s": 1.0, "duration_s": 0.001},
    "router_restart": {"down_s": 1.0, "duration_s": 0.001},
}
NODES = Nodes([f"v{n}" for n in range(1, 7)], np.arange(12.0).reshape(6, 2), np.array([0, 1, 2, 3, 4, 5]))


def minimal(kind: str, **more: Any) -> dict[str, Any]:
    return {"kind": kind, "duration_s": 2.0, **REQUIRED.get(kind, {}), **more}


def plan(written: list[dict[str, Any]], together: int = 1, duration_s: float = 30.0) -> FaultPlan:
    run = {"nodes_per_process": together, "duration_s": duration_s}
    return FaultPlan(Scenario.model_validate({"run": run, "fault": written}), NODES)


def test_the_kinds_are_those_of_the_module() -> None:
    fields = [getattr(model, "model_fields", {}) for model in vars(faults).values()]
    named = {name for model in fields if "kind" in model for name in get_args(model["kind"].annotation)}
    assert set(KINDS) == named
    assert len(KINDS) >= 29


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_has_its_defaults_and_says_what_it_lacks(kind: str) -> None:
    fault = parse_fault(minimal(kind))
    for key, value in {"at_s": 0.0, "duration_s": 2.0, **DEFAULTS.get(kind, {}), **REQUIRED.get(kind, {})}.items():
        assert getattr(fault, key) == (2.0 if key == "duration_s" else value)
    needed = [*REQUIRED.get(kind, {}), *([] if kind.endswith("r_restart") else ["duration_s"])]
    for key in needed:
        less = minimal(kind)
        del less[key]
        with pytest.raises(ScenarioError, match=rf"^fault: {kind}\.{key}: is missing$"):
            parse_fault(less)


def test_a_list_of_ids_is_a_selector() -> None:
    listed, table = (parse_fault(minimal("block", receivers=ids)) for ids in (["v1", "v3"], {"ids": ["v1", "v3"]}))
    assert listed == table
    exception = {"entry": "a:b", "nodes": {"ids": ["v1"]}}
    assert Scenario.model_validate({"program": {"exceptions": [exception]}}).program.of("v1").entry == "a:b"
    with pytest.raises(ValidationError, match=r"write the ids of the vehicles, as"):
        Scenario.model_validate({"program": {"exceptions": [{**exception, "nodes": {"count": 2}}]}})


def test_what_a_run_has_recorded_is_read_under_its_new_name_and_all_else_refused(tmp_path: Path) -> None:
    text = '[[fault]]\nkind = "kill"\nduration_s = 1.0\n[fault.nodes]\nrandom = 2\n'
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(ScenarioError, match=r"fault.0.kill.nodes: random is called count: write { count = 2 }"):
        load_scenario(tmp_path / "own.toml")
    recorded = tmp_path / "scenario.toml"
    recorded.write_text(text + "[inputs]\n[code]\n")
    for scenario in (load_scenario(recorded), parse_recorded_scenario(recorded.read_text(), recorded)):
        (fault,) = scenario.fault
        assert fault == parse_fault({"kind": "kill", "duration_s": 1.0, "nodes": {"count": 2}})


points = st.tuples(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6))
selectors = st.one_of(
    st.just({}),
    st.fixed_dictionaries({"ids": st.lists(st.sampled_from(NODES.ids), max_size=4, unique=True)}),
    st.fixed_dictionaries({"fraction": st.floats(0, 1, exclude_min=True)}),
    st.fixed_dictionaries({"count": st.integers(1, 9)}),
    st.fixed_dictionaries({"disc": st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(1e-3, 99))}),
    st.fixed_dictionaries({"polygon": st.lists(points, min_size=3, max_size=6)}),
    st.fixed_dictionaries({"degree": st.tuples(st.integers(0, 3), st.integers(3, 9))}),
)


@st.composite
def written_faults(draw: st.DrawFn) -> dict[str, Any]:
    kind = draw(st.sampled_from(tuple(KINDS)))
    fault = minimal(kind, at_s=draw(st.floats(0, 24)), duration_s=draw(st.floats(1e-9, 86_400)))
    fields = type(parse_fault(fault)).model_fields
    for name in ("nodes", "senders", "receivers"):
        if name in fields:
            fault[name] = draw(selectors)
    if kind == "partition":
        groups = st.sampled_from(["halves", "one", "ring", [["v1", "v2"], ["v3"]], [["v2"]], []])
        fault["groups"] = draw(groups)
    if kind == "swizzle" and draw(st.booleans()):
        fault["over_s"] = draw(st.floats(1e-6, 10))
    return fault


@pytest.mark.slow
@given(st.lists(written_faults(), max_size=5))
def test_any_faults_survive_being_written_and_read(
    tmp_path_factory: pytest.TempPathFactory, written: list[dict[str, Any]]
) -> None:
    original = Scenario.model_validate({"fault": written})
    path = tmp_path_factory.mktemp("dump") / "s.toml"
    path.write_text(dump_scenario(original))
    assert load_scenario(path) == original
    assert tuple(parse_fault(json.loads(fault.model_dump_json(exclude_none=True))) for fault in original.fault) == (
        original.fault
    )


@pytest.mark.parametrize("kind", KINDS)
def test_equal_faults_have_one_hash(kind: str) -> None:
    options = {"options": {"a": [1, {"b": 2}]}} if kind.startswith("custom") else {}
    assert len({parse_fault(minimal(kind, **options)) for _ in range(2)}) == 1


def same(one: FaultPlan, other: FaultPlan) -> bool:
    """Return True if two plans do the same at all times, by the same names and with the same draws."""
    return [(p.label, p.start_ns, p.end_ns, p.nodes.tolist()) for p in one.faults] == [
        (p.label, p.start_ns, p.end_ns, p.nodes.tolist()) for p in other.faults
    ]


@pytest.mark.slow
@given(st.lists(written_faults(), max_size=5), st.data())
def test_a_plan_as_it_is_written_down_is_the_same_plan_whatever_was_healed(
    tmp_path_factory: pytest.TempPathFactory, written: list[dict[str, Any]], data: st.DataObject
) -> None:
    original = plan(written)
    for _ in range(data.draw(st.integers(0, 3))):
        if original.faults:
            label = data.draw(st.sampled_from([planned.label for planned in original.faults]))
            original.heal(label, data.draw(st.integers(0, 26 * 10**9)))
    scenario = Scenario.model_validate({"fault": original.as_written()})
    path = tmp_path_factory.mktemp("dump") / "s.toml"
    path.write_text(dump_scenario(scenario))
    again = FaultPlan(load_scenario(path), NODES)
    assert same(original, again)
    instants = [t for p in original.faults for t in (p.start_ns, p.end_ns)]
    for time_ns in [t + d for t in instants for d in (-1, 0, 1)]:
        assert [p.label for p in original.active(time_ns)] == [p.label for p in again.active(time_ns)]


def test_a_fault_that_was_healed_before_it_began_never_acts_in_the_replay_either() -> None:
    """It stays in the list, because the numbers of the others depend on it."""
    first = plan([minimal("kill", at_s=5.0), minimal("loss", at_s=6.0)])
    first.heal("kill-0", 1_000_000_000)
    again = FaultPlan(Scenario.model_validate({"fault": first.as_written()}), NODES)
    assert all(not again.faults[0].acts_at(5_000_000_000 + d) for d in range(-2, 3))
    assert again.faults[1].label == "loss-1"


def test_unknown_ids_are_one_line_that_names_the_fault_and_who_there_is() -> None:
    for key in ("ids", "groups"):
        fault = (
            minimal("kill", nodes={"ids": ["v1", "w9"]}) if key == "ids" else minimal("partition", groups=[["w9"]])
        )
        with pytest.raises(ScenarioError, match=r"-1: 'w9' is no vehicle of the network; they are v1, v2, .*v6$"):
            plan([minimal("kill"), fault])
    for key in ("nodes", "senders", "receivers"):
        with pytest.raises(ScenarioError, match=r"^block-0: 'w9' is no vehicle"):
            plan([minimal("block", **{key: {"ids": ["w9"]}})])


@pytest.mark.parametrize("at_s", [25.0, 26.0, 24.9999999999])
def test_a_fault_beyond_the_time_at_which_all_is_healed_is_refused(at_s: float) -> None:
    with pytest.raises((ScenarioError, ValueError), match=r"at_s = 2\d(\.\d+)?: must be less than 25"):
        plan([minimal("kill", at_s=at_s)])


def test_all_faults_end_where_the_network_must_be_at_rest() -> None:
    planned = plan([minimal("kill", at_s=20.0) | {"duration_s": 1000.0}, minimal("loss", at_s=22.0)]).faults
    assert [p.end_ns for p in planned] == [25_000_000_000, 24_000_000_000]


@pytest.mark.parametrize("kind", ["kill", "restart", "pause"])
def test_parts_of_a_process_are_refused_with_the_names_of_the_others(kind: str) -> None:
    with pytest.raises(
        ScenarioError, match=rf"^{kind}-0: v3 shares a process with v4: name them all, or set run\."
    ):
        plan([minimal(kind, nodes={"ids": ["v1", "v2", "v3"]})], together=2)
    assert plan([minimal(kind, nodes={"ids": ["v4", "v3"]})], together=2).faults[0].nodes.sum() == 2
    assert plan([minimal(kind, nodes={"ids": ["v5", "v6"]})], together=4).faults[0].nodes.sum() == 2


@pytest.mark.parametrize("kind", ["skew", "gnss_outage", "DoS", "throttle", "swizzle"])
def test_other_faults_may_act_on_parts_of_a_process(kind: str) -> None:
    assert plan([minimal(kind, nodes={"ids": ["v3"]})], together=2).faults[0].nodes.sum() == 1


def test_no_fault_is_healed_that_is_not_there() -> None:
    with pytest.raises(ScenarioError, match=r"^no fault 'loss-3'; there are: kill-0, loss-1$"):
        plan([minimal("kill"), minimal("loss")]).heal("loss-3", 0)
    with pytest.raises(ScenarioError, match=r"there are: none$"):
        plan([]).heal("loss-3", 0)


def test_a_fault_cannot_be_changed() -> None:
    fault: Fault = parse_fault(minimal("loss"))
    with pytest.raises(ValueError, match="frozen"):
        setattr(fault, "at_s", 3.0)  # noqa: B010 - a type checker refuses the plain assignment
