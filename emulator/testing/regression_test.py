"""The test that a campaign writes beside a failure: it fails as long as the failure does not go away."""

from __future__ import annotations

from collections.abc import Sequence

TEST_FILE = "test_failure.py"
TEXT = '''"""Failure {number} of a campaign: {checks}. Written by vnet; `pytest {file}` runs it."""

from pathlib import Path

import emulator


def test_failure_{name}(tmp_path: Path) -> None:
    run = emulator.simulate(Path(__file__).with_name("scenario.toml"), out=tmp_path / "run")
    assert run.verdict != "invalid", [check for check in run.checks if check.verdict == "invalid"]
'''


def regression_test(number: str, checks: Sequence[str]) -> str:
    """Return the test of the failure of this number, of these checks."""
    name = "".join(character if character.isalnum() else "_" for character in number)
    return TEXT.format(number=number, name=name, checks=", ".join(checks), file=TEST_FILE)
