"""A kind of fault is added by one class: it acts in a run, is judged, documented, and drawn by campaigns."""

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from pydantic import Field

from docs.generate import faults as fault_page
from emulator.checks.judge import Verdict, judge
from emulator.scenario.faults import KINDS, DelayFault, Drawn, Fault, Probability, parse_fault
from emulator.scenario.loading import dump_scenario, load_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign_plan import Plan
from tests.emulator.checks.test_judge import run_scenario
from vnet.errors import ScenarioError
from vnet.types import Array

SMALL: dict[str, Any] = {"run": {"duration_s": 4.0, "settle_s": 1.0}, "network": {"vehicles": 6}}


@pytest.fixture
def spike() -> Iterator[type[Fault]]:
    """The example of CONTRIBUTING.md, registered for one test."""
    before = dict(KINDS)

    class LatencySpike(DelayFault):
        """Some frames arrive much later, by a time with a long tail (Pareto, truncated)."""

        kind: Literal["latency_spike"]
        probability: Annotated[Probability, Drawn(1, 5, per=10)] = 0.1
        """Probability of delaying a frame, at each receiver independently."""
        longest_ms: Annotated[float, Drawn(50, 500)] = Field(300.0, gt=1, le=60_000)
        """Longest extra latency; the shortest is 1 ms."""

        @property
        def bounds_ms(self) -> tuple[float, float]:
            """Zero and the longest extra latency."""
            return 0.0, self.longest_ms

        def added_ms(self, draws: Array) -> Array:
            """Return the tail at receivers (N,) whose draw is below the probability, else zero."""
            tail_ms = 1 / np.maximum(draws / self.probability, 1 / self.longest_ms)
            return np.where(draws < self.probability, tail_ms, 0.0)

    yield LatencySpike
    Fault.kinds.clear()
    Fault.kinds.update(before)


def scenario_with(**fault: Any) -> Scenario:
    written = {"kind": "latency_spike", "at_s": 1.0, "duration_s": 1.5, **fault}
    return Scenario.model_validate({**SMALL, "radio": {"loss": 0.0, "range_m": 1e5}, "fault": [written]})


@pytest.mark.slow
def test_it_acts_in_a_run_and_its_effect_is_found(tmp_path: Path, spike: type[Fault]) -> None:
    recorded = run_scenario(tmp_path / "run", scenario_with(probability=0.5))
    latency_ms = (recorded.arrival_ns - recorded.sent_ns) / 1e6
    acting = (recorded.sent_ns >= 1e9) & (recorded.sent_ns < 2.5e9)
    assert latency_ms[acting].max() > 100 > latency_ms[~acting].max()
    verdicts = {check.name: check.verdict for check in judge(recorded).checks}
    assert verdicts["effect:latency_spike-0"] is Verdict.VALID
    assert Verdict.INVALID not in verdicts.values()


@pytest.mark.slow
def test_nothing_shows_its_effect_where_it_never_strikes(tmp_path: Path, spike: type[Fault]) -> None:
    recorded = run_scenario(tmp_path / "run", scenario_with(probability=1e-12))
    (effect,) = [check for check in judge(recorded).checks if check.name == "effect:latency_spike-0"]
    assert effect.verdict is Verdict.UNKNOWN


def test_a_scenario_states_it_and_says_what_is_wrong_with_it(tmp_path: Path, spike: type[Fault]) -> None:
    path = tmp_path / "scenario.toml"
    path.write_text(dump_scenario(scenario_with(longest_ms=120.0)))
    assert isinstance(load_scenario(path).fault[0], spike)
    assert load_scenario(path) == scenario_with(longest_ms=120.0)
    with pytest.raises(ScenarioError, match=r"latency_spike\.longst_ms: unknown key \(did you mean longest_ms\?\)"):
        parse_fault({"kind": "latency_spike", "duration_s": 1.0, "longst_ms": 5.0})


@pytest.mark.slow
def test_the_reference_page_describes_it(spike: type[Fault]) -> None:
    page = fault_page.page()
    assert re.search(r"\| \*\*`latency_spike`\*\* \| links .*\| Some frames arrive much later", page)
    assert "| `longest_ms` | number | `300` | ms | > 1, ≤ 60000 | Longest extra latency" in page


@pytest.mark.slow
def test_campaigns_draw_it_with_its_parameters(spike: Any) -> None:
    plan = Plan.of(Scenario.model_validate(SMALL), "random", 300, 1)
    drawn = [fault for n in range(300) for fault in plan.draw(n).fault if isinstance(fault, spike)]
    assert drawn
    assert all(0.1 <= fault.probability <= 0.5 for fault in drawn)
    assert all(50 <= fault.longest_ms <= 500 for fault in drawn)


def test_one_name_is_one_kind(spike: type[Fault]) -> None:
    with pytest.raises(TypeError, match="fault kind 'latency_spike' is both LatencySpike and Other"):

        class Other(DelayFault):
            """Another class of the same name."""

            kind: Literal["latency_spike"]


def test_what_campaigns_draw_can_be_written() -> None:
    """Each kind draws all that it cannot do without."""
    for name, kind in KINDS.items():
        if not kind.campaign_weight:
            continue
        needed = {key for key, field in kind.model_fields.items() if field.is_required()}
        drawn = kind.draw_parameters(_First())
        assert needed - {"kind", "duration_s"} <= set(drawn), name
        parse_fault({"kind": name, "duration_s": 1.0, **kind.draw_target(_First(), [("v1",), ("v2",)]), **drawn})


class _First:
    """The first of all choices."""

    def integer(self, low: int, high: int) -> int:
        return low

    def choice(self, items: Any) -> Any:
        return items[0]

    def subset(self, items: Any, most: int) -> Any:
        return list(items[:1])
