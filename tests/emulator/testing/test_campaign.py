"""Campaigns find what is planted, shrink it, keep it, and go on whatever happens."""

import errno
import io
import json
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NoReturn

import pytest
from rich.console import Console

from emulator.cells.cells import compute, each_done
from emulator.cells.sweep import SweepPlan
from emulator.cells.worker import WorkerDiedError, WorkerTimeoutError
from emulator.checks.judge import Verdict
from emulator.records.disk import DiskError
from emulator.scenario.faults import Pause
from emulator.scenario.loading import load_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing import campaign, trial
from emulator.testing.campaign import TEST_FILE, column_of, count_verdicts, failures, page, run_campaign
from emulator.testing.campaign_plan import Plan
from emulator.testing.scenarios import make_scenario
from emulator.testing.trial import Trial, TrialPool
from tests.support import forked_commands
from tests.support.forked_commands import VNET
from tests.support.paths import ROOT
from vnet.errors import ProgramError, ScenarioError, VnetError

pytestmark = pytest.mark.slow

pytest_plugins = "pytester"


def planted(program: str, vehicles: int = 4, **changes: Any) -> Scenario:
    run: dict[str, Any] = {"name": "planted", "duration_s": 2.0, "settle_s": 0.5, **changes}
    entry = f"tests.emulator.testing.programs:{program}"
    return Scenario.model_validate({"run": run, "network": {"vehicles": vehicles}, "program": {"entry": entry}})


def failure_of(plan: Plan, folder: Path) -> dict[str, Any]:
    """The row of the only run of a campaign, which fails."""
    assert run(plan, folder)[0] == 1
    (row,) = results_of(folder)
    return row


def results_of(folder: Path) -> list[dict[str, Any]]:
    return json.loads((folder / "campaign.json").read_text())["results"]


def run(plan: Plan, folder: Path) -> tuple[int, str]:
    """The exit status of a campaign, and what it said."""
    said = io.StringIO()
    return run_campaign(plan, folder, Console(width=200, file=said)), said.getvalue()


def test_a_program_that_crashes_under_pause_is_found_and_shrunk(tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    plan = Plan.of(planted("impatient"), "pause,loss,duplicate", 2, seed=3)
    status, said = run(plan, folder)
    assert status == 1
    results = results_of(folder)
    assert [row["seed"] for row in results] == [3, 4]
    failed = [row for row in results if "failed" in row]
    assert len(failed) == 1 and len(failed[0]["faults"]) > 1
    for row in failed:
        assert list(row["failed"]) == ["agents_alive"]
        assert "RuntimeError: where has the time gone?" in row["failed"]["agents_alive"]
        shrunk = load_scenario(Path(row["folder"]) / "scenario.toml")
        (fault,) = shrunk.fault
        assert isinstance(fault, Pause)
        assert len(fault.nodes.ids or ()) == 1
        assert fault.duration_s <= 0.4
        assert row["steps"] <= 50
        again = json.loads((Path(row["folder"]) / "verdict.json").read_text())
        assert again["verdict"] == "invalid"
        assert row["folder"] in again["reproduce"]
        checked = forked_commands.run([*VNET, "check", row["folder"]], capture_output=True, text=True).stdout
        assert re.search(r"files +│ valid", checked), checked
        assert "[code]" in (Path(row["folder"]) / "scenario.toml").read_text()
        assert 'kind = "pause"' in said
        assert row["parting"]["passing"] == "the same run without faults"
    (spared,) = [row for row in results if "failed" not in row]
    assert spared["faults"] and "pause" not in {fault["kind"] for fault in spared["faults"]}
    text = (folder / "campaign.html").read_text()
    assert f"<h2>Failures: {len(failed)}</h2>" in text
    assert "vnet simulate" in text


def test_after_a_fix_a_campaign_says_whether_it_is_credible(tmp_path: Path) -> None:
    status, said = run(Plan.of(planted("growing"), "none", 1, seed=1, shrink_steps=0), tmp_path / "before")
    assert status == 1 and "once it is fixed, 59 runs without a failure" in said
    fixed, plan = io.StringIO(), Plan.of(planted("impatient"), "none", 2, seed=5)
    assert run_campaign(plan, tmp_path / "after", Console(width=200, file=fixed), before=tmp_path / "before") == 0
    assert "in 1 of 1 runs before, and in none of 2 now: a fix is credible from 59 runs on" in fixed.getvalue()
    with pytest.raises(VnetError, match="cannot be read"):
        run_campaign(plan, tmp_path / "other", Console(quiet=True), before=tmp_path / "nowhere")
    unlike = Plan.of(planted("growing"), "kill", 2, seed=5)
    with pytest.raises(VnetError, match="not comparable"):
        run_campaign(unlike, tmp_path / "other", Console(quiet=True), before=tmp_path / "before")


def test_a_campaign_finds_a_nondeterministic_program_if_asked(tmp_path: Path) -> None:
    folder = tmp_path / "campaign"
    status, _ = run(Plan.of(planted("sends_a_set"), "none", 1, seed=1), tmp_path / "unasked")
    assert status == 0
    plan = Plan.of(planted("sends_a_set"), "none", 1, seed=1, shrink_steps=3, check_determinism=True)
    row = failure_of(plan, folder)
    assert list(row["failed"]) == ["replay"]
    assert "programs.py:" in row["failed"]["replay"]
    test = kept_test(row).read_text()
    assert "twice=True" in test
    assert list(failures(Path(row["folder"]) / "scenario.toml", tmp_path / "again", 60, twice=True)) == ["replay"]
    assert "--check-determinism" in (folder / "campaign.html").read_text()


def test_a_deterministic_program_passes_a_campaign_that_compares(tmp_path: Path) -> None:
    plan = Plan.of(planted("proud"), "kill,loss,pause", 2, seed=1, check_determinism=True)
    pool = TrialPool(60.0, plan.scenario, twice=True)
    assert "replay" not in pool.run_anywhere(plan.draw(0)).failed
    pool.close()


def test_on_an_executor_a_campaign_finds_the_same(tmp_path: Path) -> None:
    plan = Plan.of(planted("impatient"), "pause", 1, seed=1, shrink_steps=1)
    quiet = Console(quiet=True)
    here = run_campaign(plan, tmp_path / "here", quiet)
    with ThreadPoolExecutor(2) as executor:
        there = run_campaign(plan, tmp_path / "there", quiet, executor)
    assert here == there == 1
    told = [[{**row, "wall_s": 0, "folder": ""} for row in results_of(tmp_path / n)] for n in ("here", "there")]
    assert told[0] == told[1]
    kept = next(row for row in results_of(tmp_path / "there") if "failed" in row)
    assert (Path(kept["folder"]) / "verdict.json").exists(), "what has failed is kept on this machine"


def test_a_fatal_signal_is_the_death_of_its_vehicle(tmp_path: Path) -> None:
    row = failure_of(Plan.of(planted("faulty"), "none", 1, seed=1, shrink_steps=3), tmp_path / "campaign")
    assert list(row["failed"]) == ["agents_alive"]
    assert "SIGSEGV" in row["failed"]["agents_alive"]
    verdict = json.loads((Path(row["folder"]) / "verdict.json").read_text())
    (alive,) = (check for check in verdict["checks"] if check["name"] == "agents_alive")
    assert "v01" in {each["node"] for each in alive["figures"]["gone"]}
    assert list(failures(Path(row["folder"]) / "scenario.toml", tmp_path / "again", 60)) == ["agents_alive"]


def test_a_process_that_ends_only_with_all_vehicles_in_it_has_failed() -> None:
    pool = TrialPool(60.0, planted("faulty_in_company"))
    trial = pool.run_anywhere(planted("faulty_in_company"))
    pool.close()
    assert trial.failed == ["emulator"]
    assert "SIGABRT" in trial.texts["emulator"]


@pytest.mark.parametrize(
    ("error", "failed"),
    [(WorkerTimeoutError("not over within 2 s"), ["hung"]), (WorkerDiedError("killed"), ["emulator"])],
    ids=["hung", "killed"],
)
def test_what_hangs_or_dies_on_an_executor_has_failed(error: VnetError, failed: list[str]) -> None:
    assert TrialPool(2.0, planted("proud"), Failing(error)).run_anywhere(planted("proud")).failed == failed


def test_a_worker_that_is_killed_once_is_the_machine_s_and_no_failure() -> None:
    trial = Trial({"safe": Verdict.VALID}, {})
    once = Failing(WorkerDiedError("its process ended with SIGKILL"), then=trial)
    assert TrialPool(2.0, planted("proud"), once).run_anywhere(planted("proud")) == trial


@pytest.mark.parametrize("error", [BrokenExecutor(), CancelledError()], ids=["broken", "without its scheduler"])
def test_an_executor_that_is_broken_ends_campaign_and_sweep(error: Exception) -> None:
    with pytest.raises(VnetError, match="the executor is broken"):
        TrialPool(2.0, planted("proud"), Failing(error)).run_anywhere(planted("proud"))
    cells = SweepPlan.of(planted("proud"), {}, [1]).cells
    with pytest.raises(VnetError, match="the executor is broken; run it again to go on"):
        next(each_done(cells, compute, Failing(error)))


class Failing(Executor):
    """Fails whatever it is to do, or only at first, and then has a result."""

    def __init__(self, error: Exception, then: Trial | None = None) -> None:
        self._error = error
        self._then = then
        self._failed = False

    def submit(self, *_: Any, **__: Any) -> Future[Any]:
        future: Future[Any] = Future()
        if self._failed and self._then is not None:
            future.set_result(self._then)
        else:
            future.set_exception(self._error)
        self._failed = True
        return future


def test_a_failed_check_of_the_users_own_is_shrunk_and_a_broken_one_is_unknown(tmp_path: Path) -> None:
    (tmp_path / "own_campaign_checks.py").write_text(
        "def paused(run):\n"
        "    pauses = [fault for fault in run.scenario.fault if fault.kind == 'pause']\n"
        "    yield 'unpaused', 'invalid' if pauses else 'valid', f'{len(pauses)} pauses'\n\n"
        "def broken(run):\n    raise ValueError(run.nodes[0])\n"
    )
    checks = [f"{tmp_path}/own_campaign_checks.py:{function}" for function in ("paused", "broken")]
    scenario = make_scenario(planted("proud"), {"program": "agents.beacon:main"})
    status, said = run(Plan.of(make_scenario(scenario, {"checks": checks}), "pause", 1, 1), tmp_path / "paused")
    assert status == 1
    (row,) = results_of(tmp_path / "paused")
    assert row["failed"] == {"own:unpaused": "1 pauses"}
    assert row["shrunk"].count("[[fault]]") == 1
    assert "unknown in 1 run: own:own_campaign_checks.broken: raises ValueError: v01" in said
    both = make_scenario(planted("growing"), {"checks": checks[:1]})
    row = failure_of(Plan.of(both, "pause", 1, 1), tmp_path / "both")
    assert row["shrunk"] == "" and set(row["failed"]) == {"growth", "own:unpaused"}, "also what was shrunk away"
    status, said = run(Plan.of(make_scenario(scenario, {"checks": checks}), "none", 1, seed=1), tmp_path / "none")
    assert (status, "1 run, 0 failed" in said) == (3, True)


def test_runs_and_checks_of_which_nothing_is_known_are_no_pass(tmp_path: Path) -> None:
    (tmp_path / "own_seed_check.py").write_text(
        "def check(run):\n"
        "    yield 'typo', 'unknown', 'there was nothing to judge'\n"
        "    yield 'once', 'valid' if run.scenario.run.seed == 1 else 'unknown', 'nothing this time'\n"
    )
    scenario = make_scenario(planted("proud"), {"checks": [f"{tmp_path}/own_seed_check.py:check"]})
    status, said = run(Plan.of(scenario, "none", 2, seed=1), tmp_path / "checks")
    assert (status, "2 runs, 0 failed" in said) == (3, True)
    assert "unknown in 2 runs: own:typo: there was nothing to judge" in said and "own:once" not in said
    assert "own:typo was unknown in 2 runs: there" in (tmp_path / "checks" / "campaign.html").read_text()
    status, said = run(Plan.of(planted("interrupts"), "none", 2, seed=1), tmp_path / "runs")
    assert (status, "2 runs, 0 failed" in said) == (3, True)
    assert "unknown in 2 runs: progress: interrupted at 0.5" in said


def test_what_hangs_is_killed_and_the_campaign_goes_on(tmp_path: Path, pytester: pytest.Pytester) -> None:
    plan = Plan.of(planted("stubborn"), "kill", 1, seed=1, limit_s=1.0, shrink_steps=0)
    row = failure_of(plan, tmp_path / "campaign")
    assert row["failed"] == {"hung": "not over within 1 s of wall clock; logs/stacks.txt says where it stood"}
    assert load_scenario(Path(row["folder"]) / "scenario.toml").fault
    assert "hung" in said_by_pytest(kept_test(row), pytester)


def kept_test(row: dict[str, Any]) -> Path:
    """The test of a failure, in the folder that a row of the campaign's results names."""
    folder = Path(row["folder"])
    return folder / TEST_FILE.format(folder.name)


def said_by_pytest(test: Path, pytester: pytest.Pytester) -> str:
    """The output of pytest on a failure's test, which fails."""
    done = pytester.runpytest_inprocess("-q", "-p", "no:cacheprovider", str(test))
    assert done.ret == 1, done.stdout.str()
    return done.stdout.str()


def test_a_failure_that_has_gone_away_lets_its_test_pass(tmp_path: Path) -> None:
    (tmp_path / "scenario.toml").write_text("[network]\nvehicles = 2\n[run]\nduration_s = 1.0\n")
    assert failures(tmp_path / "scenario.toml", tmp_path / "run", limit_s=60.0) == {}


def test_numbers_that_are_none_and_that_grow_are_found(tmp_path: Path, pytester: pytest.Pytester) -> None:
    plan = Plan.of(planted("proud"), "partition,block", 3, seed=1, shrink_steps=4)
    run(plan, tmp_path / "proud")
    assert any("finite" in row.get("failed", {}) for row in results_of(tmp_path / "proud"))
    row = failure_of(Plan.of(planted("growing"), "loss", 1, seed=1, shrink_steps=2), tmp_path / "growing")
    assert list(row["failed"]) == ["growth"]
    assert row["shrunk"] == "", "it grows without any fault"
    assert "growth" in said_by_pytest(test := kept_test(row), pytester)
    page = (tmp_path / "growing" / "campaign.html").read_text()
    assert f"<pre>pytest {test}</pre>" in page, "no other command looks for growth"


def test_coordinates_of_the_network_are_no_growth(tmp_path: Path) -> None:
    (tmp_path / "utm.csv").write_text("id,x_m,y_m,heading_rad\na,500000,5400000,0\nb,500010,5400000,0\n")
    far = Scenario.model_validate(
        {
            "run": {"duration_s": 1.0, "settle_s": 0.0},
            "network": {"kind": "file", "path": tmp_path / "utm.csv"},
            "program": {"entry": "agents.beacon:main"},
        }
    )
    assert run(Plan.of(far, "none", 1, seed=1, shrink_steps=0), tmp_path / "far")[0] == 0


def test_an_interrupted_campaign_keeps_what_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(futures: list[Future[Any]]) -> Iterator[Future[Any]]:
        futures[0].result()
        yield futures[0]
        signal.raise_signal(signal.SIGTERM)

    def write_under_fire(self: campaign.Campaign) -> None:
        signal.raise_signal(signal.SIGINT)  # a second one
        write(self)

    write = campaign.Campaign.write
    before = signal.getsignal(signal.SIGTERM)
    monkeypatch.setattr(campaign, "as_completed", interrupted)
    monkeypatch.setattr(campaign.Campaign, "write", write_under_fire)
    status, _ = run(Plan.of(planted("impatient"), "loss", 40, seed=1, jobs=1), tmp_path / "campaign")
    assert status == 130
    assert signal.getsignal(signal.SIGTERM) == before
    results = results_of(tmp_path / "campaign")
    assert 1 <= len(results) < 40
    assert results[0]["seed"] == 1
    assert f"{len(results)} of 40 runs" in (tmp_path / "campaign" / "campaign.html").read_text()


def refuse_what_is_beside_a_run(monkeypatch: pytest.MonkeyPatch) -> None:
    def put(self: Path, target: Path) -> Path:
        if target.parent.name in ("001", "002"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return replace(self, target)

    replace = Path.replace
    monkeypatch.setattr(Path, "replace", put)


def refuse_whole_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    def run_in_a_file(pool: TrialPool, scenario: Scenario, folder: Path, apart: bool = False) -> Trial:
        return run_kept(pool, scenario, Path("/dev/full") / folder.name, apart)

    run_kept = TrialPool.run
    monkeypatch.setattr(TrialPool, "run", run_in_a_file)


@pytest.mark.parametrize("refuse", [refuse_what_is_beside_a_run, refuse_whole_runs])
def test_a_disk_that_is_full_loses_no_results(
    refuse: Callable[[pytest.MonkeyPatch], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse(monkeypatch)
    said, plan = io.StringIO(), Plan.of(planted("growing"), "loss", 2, seed=1, shrink_steps=2)
    with pytest.raises(VnetError, match=r"00[12].*: cannot write: .*, and \d more$"):
        run_campaign(plan, tmp_path / "campaign", Console(width=200, file=said))
    assert "2 runs, 2 failed" in said.getvalue()
    for row in results_of(tmp_path / "campaign"):
        assert (list(row["failed"]), row["steps"]) == (["growth"], 2)
    assert "<h2>Failures: 2</h2>" in (tmp_path / "campaign" / "campaign.html").read_text()
    assert not (tmp_path / "campaign" / ".room").exists()


def test_what_the_disk_refuses_is_no_failure_of_the_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> NoReturn:
        raise DiskError("verdict.json: cannot write")

    monkeypatch.setattr(trial, "run_trial", refuse)
    with pytest.raises(DiskError):
        trial._run_unkept(planted("proud"), tmp_path / "run", 60.0, False, 1)


def test_what_cannot_be_a_campaign_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ScenarioError, match="a campaign's runs take 20 s at most"):
        Plan.of(Scenario(), "random", 1, 1)
    with pytest.raises(ScenarioError, match="fault 'router_restart': must be one of"):
        Plan.of(planted("impatient"), "router_restart", 1, 1)
    with pytest.raises(ProgramError, match="has no 'missing'"):
        Plan.of(planted("missing"), "random", 1, 1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "file").touch()
    with pytest.raises(VnetError, match="exists and is not an empty folder"):
        run_campaign(Plan.of(planted("impatient"), "random", 1, 1), tmp_path / "full", Console(quiet=True))


def test_the_command_says_by_its_status_whether_anything_failed(tmp_path: Path) -> None:
    command = [*VNET, "campaign", str(ROOT / "scenarios" / "beacon.toml")]
    options = ["--runs", "2", "--duration", "1", "--set", "run.settle_s=0.2", "--set", "network.vehicles=3"]
    out = tmp_path / "campaign"
    done = forked_commands.run([*command, *options, "--out", str(out)], cwd=ROOT, capture_output=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "2 runs, 0 failed" in done.stderr
    assert "Warning" not in done.stderr
    assert len(results_of(out)) == 2


class Reader(HTMLParser):
    """Rows of a page's table, and whatever it would load from elsewhere."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.cells: list[str] = []
        self.foreign: list[str] = []
        self.feed(text)

    inside = False

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag in ("script", "link", "img", "iframe") or any("//" in (value or "") for _, value in attributes):
            self.foreign.append(tag)
        if tag == "td":
            self.cells.append("")
            self.inside = True

    def handle_endtag(self, tag: str) -> None:
        self.inside = self.inside and tag != "td"

    def handle_data(self, data: str) -> None:
        if self.inside:
            self.cells[-1] += data


def test_the_matrix_counts_by_kind_and_check() -> None:
    valid, invalid, unknown = Verdict.VALID, Verdict.INVALID, Verdict.UNKNOWN
    runs = [
        (["kill", "loss"], {"range": valid, "effect:kill-0": valid, "effect:loss-1": unknown}),
        (["kill", "kill"], {"range": invalid, "effect:kill-0": valid, "effect:kill-1": invalid}),
    ]
    assert column_of("effect:kill-0") == ("effect (its own)", "kill")
    assert column_of("loss_rate") == ("loss_rate", None)
    matrix = count_verdicts(runs)
    assert matrix == {
        "kill": {"range": Counter({valid: 1, invalid: 1}), "effect (its own)": Counter({valid: 2, invalid: 1})},
        "loss": {"range": Counter({valid: 1}), "effect (its own)": Counter({unknown: 1})},
    }


def test_the_page_needs_nothing_else_and_escapes_what_programs_say() -> None:
    matrix = count_verdicts([(["kill"], {"range": Verdict.VALID}), (["loss"], {"finite": Verdict.INVALID})])
    failure = {
        "number": "001",
        "seed": 3,
        "checks": {"finite": "<script>alert(1)</script>"},
        "schedule": '[[fault]]\nkind = "loss"',
        "order": "FIFO, except <b>",
        "command": "vnet simulate 'a & b'",
        "folder": "failures/001",
        "parting": None,
    }
    text = page("Campaign <b>", ["2 of 2 runs"], matrix, [failure])
    reader = Reader(text)
    assert reader.foreign == []
    assert [cell.replace("\xa0", " ") for cell in reader.cells] == ["1 ✓", "·", "·", "1 ✗"]
    assert "Campaign &lt;b&gt;" in text
    assert "http" not in text.replace("http-equiv", "")
