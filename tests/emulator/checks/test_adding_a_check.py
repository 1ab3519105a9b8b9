"""A check is added by one entry of the table: it judges runs, is documented, and has a column in campaigns."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from docs.generate import checks as check_page
from emulator.checks.judge import (
    CHECKS,
    MACHINE,
    RADIO,
    Check,
    RecordedRun,
    Subject,
    Verdict,
    WithoutPositions,
    check_run,
    judge,
)
from emulator.records.verdicts import CheckResult, Finding, invalid, not_exercised, result, unknown
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign import count_verdicts
from tests.support.recorded import recorded as record_run

LIMIT_BYTES = 100


def check_frame_size(recorded: RecordedRun) -> Finding:
    """Check that no frame is longer than the limit: the example of CONTRIBUTING.md."""
    if recorded.scenario.program.entry == "agents.averaging:main":
        return not_exercised("frames of this program grow with the network")
    if not len(recorded.trace):
        return unknown("no frame was sent")
    longer = recorded.column("size_bytes") > LIMIT_BYTES
    text = f"{len(longer):,} receptions of frames of {LIMIT_BYTES} bytes or less"
    broken_text = f"{int(longer.sum()):,} receptions of longer frames"
    return result(int(longer.sum()), text, broken_text, recorded.rows(longer), limit_bytes=LIMIT_BYTES)


FRAME_SIZE = Check(
    check_frame_size,
    RADIO,
    f"No frame is longer than {LIMIT_BYTES} bytes.",
    invalid="a longer frame",
    unknown="no frame was sent",
    not_applicable="the program's frames grow with the network",
)


@pytest.fixture
def added() -> Iterator[None]:
    """The table with one more entry, for one test."""
    CHECKS.append(FRAME_SIZE)
    yield
    CHECKS.remove(FRAME_SIZE)


def simulated(folder: Path, entry: str = "agents.beacon:main", duration_s: float = 2.0) -> Path:
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": duration_s, "settle_s": 0.0},
            "network": {"vehicles": 4},
            "radio": {"range_m": 1e5},
            "program": {"entry": entry},
        }
    )
    record_run(scenario, folder)
    return folder


@pytest.mark.slow
@pytest.mark.usefixtures("added")
def test_it_is_in_the_verdict_of_a_run_and_of_vnet_check(tmp_path: Path) -> None:
    folder = simulated(tmp_path / "run")
    written = json.loads((folder / "verdict.json").read_text())
    (found,) = [check for check in written["checks"] if check["name"] == "frame_size"]
    assert (found["verdict"], found["figures"]) == ("valid", {"limit_bytes": LIMIT_BYTES})
    assert "frame_size" in {check.name for check in check_run(folder).checks}


@pytest.mark.slow
@pytest.mark.usefixtures("added")
def test_it_makes_a_run_invalid_and_shows_the_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = simulated(tmp_path / "run")
    monkeypatch.setattr(f"{__name__}.LIMIT_BYTES", 1)
    judgement = check_run(folder)
    assert judgement.verdict is Verdict.INVALID
    (found,) = [check for check in judgement.checks if check.name == "frame_size"]
    assert len(found.figures["rows"]) == 10


@pytest.mark.slow
@pytest.mark.usefixtures("added")
def test_its_reason_not_to_apply_is_listed(tmp_path: Path) -> None:
    judgement = check_run(simulated(tmp_path / "run", "agents.averaging:main"))
    reasons = {left.name: left.reason for left in judgement.not_exercised}
    assert reasons["frame_size"] == "frames of this program grow with the network"


@pytest.mark.usefixtures("added")
def test_the_reference_page_has_its_row() -> None:
    row = "| `frame_size` | No frame is longer than 100 bytes. | a longer frame | no frame was sent | the program's"
    assert row in check_page.page()


@pytest.mark.slow
@pytest.mark.usefixtures("added")
def test_a_campaign_has_its_column(tmp_path: Path) -> None:
    checks = check_run(simulated(tmp_path / "run")).checks
    matrix = count_verdicts([(["kill"], {check.name: check.verdict for check in checks})])
    assert matrix["kill"]["frame_size"] == {Verdict.VALID: 1}


@pytest.mark.slow
def test_without_positions_each_check_is_treated_as_its_entry_says(tmp_path: Path) -> None:
    recorded = RecordedRun.open(simulated(tmp_path / "run", duration_s=0.05))
    assert not len(recorded.states)
    judgement = judge(recorded)
    unknown_names = {check.name for check in judgement.checks if check.verdict is Verdict.UNKNOWN}
    for check in CHECKS:
        if check.without_positions is WithoutPositions.UNKNOWN:
            assert check.name in unknown_names
        elif check.without_positions is WithoutPositions.NOT_APPLICABLE and not check.per_fault:
            assert check.name in {left.name for left in judgement.not_exercised}


def test_names_are_unique_and_documented() -> None:
    names = [check.name for check in CHECKS]
    assert len(names) == len(set(names))
    assert all(check.claims for check in CHECKS)
    assert {"transport", "kept_up", "memory"} == {c.name for c in CHECKS if c.subject is Subject.MACHINE}


@pytest.mark.slow
def test_a_check_of_the_machine_is_never_invalid(tmp_path: Path) -> None:
    recorded = RecordedRun.open(simulated(tmp_path / "run"))
    for check in CHECKS:
        found = list(replace(check, function=lambda recorded: invalid("as bad as can be")).findings(recorded))
        expected = Verdict.UNKNOWN if check.subject is Subject.MACHINE else Verdict.INVALID
        assert [finding.verdict for finding in found if isinstance(finding, CheckResult)] == [expected]
        assert not (check.subject is Subject.MACHINE and check.invalid)
    with pytest.raises(AssertionError):
        Check(check_frame_size, MACHINE, "", invalid="too long", subject=Subject.MACHINE)
