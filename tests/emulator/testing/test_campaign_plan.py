"""The runs of a campaign are drawn from its seed, with time for faults; failures of one kind are one line."""

from pathlib import Path

import pytest

from emulator.checks.judge import Verdict
from emulator.report.index import write_index
from emulator.scenario.faults import KINDS, Delay, Drawn, GnssJump
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign import CampaignRun, FailureKind, count_verdicts, failure_kinds, page
from emulator.testing.campaign_plan import Plan, parse_ranges, simulated_kinds
from emulator.testing.trial import Trial, with_faults
from tests.support.paths import ROOT
from vnet.errors import ScenarioError


def scenario(duration_s: float, settle_s: float) -> Scenario:
    return Scenario.model_validate(
        {
            "run": {"duration_s": duration_s, "settle_s": settle_s},
            "network": {"vehicles": 4},
            "fault": [{"kind": "loss", "duration_s": 0.1, "probability": 0.1}] if duration_s > settle_s else [],
        }
    )


def test_a_scenario_that_leaves_no_time_for_faults_gets_some_and_is_told() -> None:
    plan = Plan.of(load_scenario(ROOT / "scenarios" / "twelve.toml"), "random", 3, seed=1)
    assert plan.note == "run.settle_s = 5 leaves no time for faults in 5 s: this campaign takes 2.5"
    for number in range(3):
        drawn = plan.draw(number)
        assert drawn.run.settle_s == 2.5
        assert all(fault.at_s + fault.duration_s <= 2.5 + 1e-9 for fault in drawn.fault)
        assert drawn.fault


def test_a_scenario_that_leaves_time_for_faults_is_taken_as_it_is() -> None:
    plan = Plan.of(scenario(2.0, 0.5), "random", 1, seed=1)
    assert (plan.note, plan.draw(0).run.settle_s) == ("", 0.5)


def test_without_faults_the_runs_differ_by_their_seeds() -> None:
    plan = Plan.of(scenario(2.0, 2.0), "none", 2, seed=7)
    first, second = plan.draw(0), plan.draw(1)
    assert plan.note == "" and plan.kinds == () and first.fault == second.fault == ()
    assert [drawn.run.seed for drawn in (first, second)] == [7, 8]
    assert [drawn.network.seed for drawn in (first, second)] == [7, 8]
    assert first.run.settle_s == 2.0
    assert [fault.kind for fault in Plan.of(scenario(2.0, 0.5), "none", 1, seed=1).draw(0).fault] == ["loss"]


def test_a_plan_leaves_the_networks_of_its_runs_to_the_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = Plan.of(scenario(2.0, 0.5), "random", 2, seed=7)
    monkeypatch.setattr("emulator.testing.campaign_plan.build_world", None)
    assert [len(plan.draw(number).fault) > 1 for number in range(2)] == [True, True]


def test_a_run_too_short_for_faults_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"run.duration_s - run.settle_s = 0.05: leaves no time for faults"):
        Plan.of(scenario(0.1, 0.1), "random", 1, seed=1)
    assert Plan.of(scenario(0.1, 0.1), "none", 1, seed=1).kinds == ()


def test_the_matrix_counts_runs_without_faults() -> None:
    matrix = count_verdicts([([], {"range": Verdict.VALID}), ([], {"range": Verdict.INVALID})])
    assert matrix == {"no faults": {"range": {Verdict.VALID: 1, Verdict.INVALID: 1}}}


def test_failures_that_differ_in_numbers_and_names_are_of_one_kind() -> None:
    crash = "1 of 10 nodes: {} crashed at {} s: UnicodeDecodeError: 'utf-8' can't decode byte {} in position {}"
    failures = [
        ("002", {"finite": "3 reports with NaN or infinity"}),
        ("004", {"agents_alive": crash.format("v04", 1.5, "0xcf", 28)}),
        (
            "009",
            {
                "agents_alive": crash.format("v10", 12, "0x8", 1),
                "effect:kill-0": "nothing",
                "effect:kill-1": "nothing",
            },
        ),
    ]
    assert failure_kinds(failures) == [
        FailureKind("agents_alive", failures[1][1]["agents_alive"], "004", 2),
        FailureKind("finite", "3 reports with NaN or infinity", "002"),
        FailureKind("effect (its own)", "nothing", "009"),
    ]
    text = page("Campaign", [], {}, [], failure_kinds(failures))
    assert '<td class="number">2</td><td>agents_alive</td><td><a href="#failure-004">004</a>: 1 of 10 nodes' in text


def test_a_failure_that_only_some_kept_runs_show_again_is_of_one_kind_and_noted() -> None:
    one = Trial.failure("growth", "x holds 1e9")
    both = Trial(one.verdicts | {"own:unpaused": Verdict.INVALID}, one.texts | {"own:unpaused": "1 pauses"})
    drawn = scenario(2.0, 0.5)
    same, less = with_faults(drawn, drawn.fault), with_faults(drawn, ())
    runs = [
        CampaignRun(n + 1, drawn, both, each, again)
        for n, (each, again) in enumerate([(same, both), (same, one), (less, one)])
    ]
    assert {kind.check: kind.runs for kind in failure_kinds((r.label, r.texts()) for r in runs)} == {
        "growth": 3,
        "own:unpaused": 3,
    }
    kept, again, shrunk = (run.told()["own:unpaused"] for run in runs)
    assert kept == "1 pauses" and again != kept and "shrunk" not in again and "not in the shrunk run" in shrunk
    assert all(run.told()["growth"] == "x holds 1e9" for run in runs)


def test_the_list_of_runs_has_the_campaigns(tmp_path: Path) -> None:
    for name, text in {
        "camp": '{"format": 1, "seed": 3, "runs": 4, "kinds": ["kill"], "results": [{"failed": {}}, {"seed": 4}]}',
        "seeds": '{"seed": 3, "runs": 1, "kinds": [], "results": [{"seed": 4}]}',
        "odd": '{"seed": 3, "runs": "<b>", "kinds": [], "results": []}',
        "none": "{",
    }.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "campaign.json").write_text(text)
    (tmp_path / "camp" / "campaign.html").touch()
    index = write_index(tmp_path).read_text()
    assert '<a href="./camp/campaign.html">camp</a>' in index
    assert '<td class="number">2 of 4</td><td class="number invalid">1</td>\n<td>kill</td>' in index
    assert '<td class="number">1</td><td class="number ">0</td>\n<td>none</td>' in index
    assert "runs = &#39;&lt;b&gt;&#39;: " in index
    assert "campaign.json: not JSON" in index


def test_a_list_without_campaigns_says_nothing_of_them(tmp_path: Path) -> None:
    assert "Campaigns" not in write_index(tmp_path).read_text()


def test_a_campaign_draws_from_other_ranges_if_asked() -> None:
    ranges = parse_ranges(["delay.delay_ms=1000..2000", "gnss_jump.offset_m=-100..-60"])
    plan = Plan.of(scenario(2.0, 0.5), "delay,gnss_jump", 40, seed=1, ranges=ranges)
    drawn = [fault for number in range(40) for fault in plan.draw(number).fault]
    delays = [fault.delay_ms for fault in drawn if isinstance(fault, Delay)]
    jumps = [number for fault in drawn if isinstance(fault, GnssJump) for number in fault.offset_m]
    assert delays and all(1000 <= delay <= 2000 for delay in delays) and max(delays) > 1500
    assert jumps and all(-100 <= jump <= -60 for jump in jumps)


def test_the_ranges_of_the_kinds_are_what_is_drawn_without_others() -> None:
    plain = Plan.of(scenario(2.0, 0.5), "random", 10, seed=1)
    same = [f"{kind}.{key}={law.bounds[0]}..{law.bounds[1]}" for kind, key, law in all_ranges()]
    asked = Plan.of(scenario(2.0, 0.5), "random", 10, seed=1, ranges=parse_ranges(same))
    assert same
    assert [plain.draw(number) for number in range(10)] == [asked.draw(number) for number in range(10)]


def all_ranges() -> list[tuple[str, str, Drawn]]:
    return [(kind, key, law) for kind in simulated_kinds() for key, law in KINDS[kind].drawn_ranges().items()]


def test_the_reference_has_each_range_that_is_drawn() -> None:
    text = (ROOT / "docs" / "reference" / "faults.md").read_text()
    for kind, key, law in all_ranges():
        low, high = law.bounds
        of_kind = text.partition(f"| **`{kind}`** |")[2].partition("| **`")[0]
        row = next(line for line in of_kind.splitlines() if line.startswith(f"| `{key}` "))
        assert f"a campaign: {low:g} to {high:g} " in row
