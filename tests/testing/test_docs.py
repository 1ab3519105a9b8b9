"""The examples of docs/testing.md are tests, and pass."""

import re
from pathlib import Path

import pytest

pytest_plugins = "pytester"

ROOT = Path(__file__).parents[2]
EXAMPLES = re.findall(r"```python\n(.*?)```", (ROOT / "docs" / "testing.md").read_text(), re.DOTALL)


@pytest.mark.parametrize("number", range(len(EXAMPLES)))
def test_an_example_passes(pytester: pytest.Pytester, number: int) -> None:
    path = pytester.makepyfile(EXAMPLES[number])
    (pytester.path / "scenarios").symlink_to(ROOT / "scenarios")
    # Here, and not for users, vnet has been imported before pytest loads its plugin.
    outcomes = pytester.runpytest("-W", "ignore::pytest.PytestAssertRewriteWarning", str(path)).parseoutcomes()
    assert set(outcomes) == {"passed"}


def test_the_page_has_examples() -> None:
    assert len(EXAMPLES) == 3
    assert all("vnet_emulation" in example for example in EXAMPLES)
