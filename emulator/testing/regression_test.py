"""The test that a campaign writes beside a failure: it fails as long as the failure does not go away."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emulator.scenario.loading import load_scenario
from emulator.testing.trial import REPLAY, TrialPool

TEST_FILE = "test_failure.py"
TEXT = '''"""Failure {number} of a campaign: {checks}. Written by vnet; `pytest {file}` runs it."""

from pathlib import Path

from emulator.testing.regression_test import failures


def test_failure_{name}(tmp_path: Path) -> None:
    scenario = Path(__file__).with_name("scenario.toml")
    assert failures(scenario, tmp_path / "run", limit_s={limit_s:g}{twice}) == {{}}
'''


def regression_test(number: str, checks: Sequence[str], limit_s: float) -> str:
    """Return the test of the failure of this number, of these checks, whose run may take `limit_s` seconds."""
    name = "".join(character if character.isalnum() else "_" for character in number)
    twice = ", twice=True" if REPLAY in checks else ""
    return TEXT.format(
        number=number, name=name, checks=", ".join(checks), file=TEST_FILE, limit_s=limit_s, twice=twice
    )


def failures(scenario: Path, folder: Path, limit_s: float, twice: bool = False) -> dict[str, str]:
    """Simulate a scenario as a campaign does, and return the texts of the checks that fail by their names.

    It runs in a process of its own, and its files stay in `folder`. One that takes more than `limit_s` seconds, or
    ends its process, has failed; `twice` has it made again in another way. Raises VnetError if it cannot be run.
    """
    loaded = load_scenario(scenario)
    pool = TrialPool(limit_s, loaded, twice=twice)
    try:
        trial = pool.run(loaded, folder)
    finally:
        pool.close()
    return {name: trial.texts[name] for name in trial.failed}
