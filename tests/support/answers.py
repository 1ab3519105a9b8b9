"""Wrong answers of functions of the user's own, and what is said of each: tests/golden/answers.txt."""

import re

import pytest

from tests.support.paths import ROOT

_BLOCK = re.compile(r"^(\w+): (.+)\n=> (.+)$", re.MULTILINE)


def answers(*kinds: str) -> pytest.MarkDecorator:
    """Parametrize by `kind`, `answer` (an expression) and the beginning of what is `said` of it."""
    text = (ROOT / "tests" / "golden" / "answers.txt").read_text(encoding="utf-8")
    rows = [found for found in _BLOCK.findall(text) if found[0] in kinds]
    assert {kind for kind, *_ in rows} == {*kinds}
    return pytest.mark.parametrize(("kind", "answer", "said"), rows, ids=[answer[:40] for _, answer, _ in rows])
