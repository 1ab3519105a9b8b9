"""Every fenced block of the README and of docs/ is what it says: read, run, and compared with what it prints.

That takes minutes. A page that passed is followed again once it, an example, a command or the public interface has
changed; in CI (if the environment has `CI`), always.
"""

import contextlib
import gc
import os
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.docs.commands import DocsError
from tests.docs.markdown import PAGES, blocks
from tests.docs.once import key_of, unless_passed
from tests.docs.pages import Page, check_workflow, shows
from tests.support.forked_commands import NO_CHARTS
from tests.support.paths import ROOT

pytestmark = pytest.mark.slow


@pytest.fixture
def page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Page:
    """A reader with an empty folder, a terminal 100 columns wide, and no colours."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")
    monkeypatch.setenv("PYTHONHASHSEED", "0")  # otherwise commands start themselves anew
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("PYTEST_DEBUG_TEMPROOT", str(tmp_path))
    monkeypatch.setenv(
        "PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    )  # commands in commands
    for name, value in NO_CHARTS.items():  # as in processes that are forked
        monkeypatch.setattr(f"emulator.pages.canvas.{name}", value)
    for name in ("FORCE_COLOR", "DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)  # a file may be written twice within a second
    return Page(tmp_path)


USED = ("docs/examples/**/*", "scenarios/*", "emulator/*.py", "emulator/cli/**/*", "agents/*.py", "vnet/*.py")
"""Files that every page may use, beside the code that follows pages, and the sources of its excerpts."""


def used_by(path: Path) -> list[Path]:
    """Return a page and the files that it may use."""
    excerpts = [ROOT / name for name in re.findall(r"^```python of (\S+)$", path.read_text("utf-8"), re.MULTILINE)]
    return [path, *excerpts, *(file for used in (*USED, "tests/docs/*.py") for file in ROOT.glob(used))]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_a_page_is_what_it_says(path: Path, page: Page, pytestconfig: pytest.Config) -> None:
    name = str(path.relative_to(ROOT))
    with unless_passed(pytestconfig, name, used_by(path)):
        page.follow(path.read_text(encoding="utf-8"), name)
        gc.collect()  # a file that the page has left open fails this test, and no later one


def test_a_page_is_followed_again_once_what_it_uses_has_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(f"{__name__}.ROOT", tmp_path)
    keys = set()
    for name in ("page.md", "emulator/cli/run.py", "docs/examples/a/b.toml", "vnet/node.py", "docs/of.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("```python of docs/of.py\n```\n")
        keys.add(key_of(used_by(tmp_path / "page.md")))
    assert len(keys) == 5


def test_what_has_passed_is_skipped_but_not_in_ci_nor_what_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("CI", raising=False)
    stored: dict[str, str] = {}
    config: Any = SimpleNamespace(cache=SimpleNamespace(get=stored.get, set=stored.__setitem__))
    ran = []

    def run(outcome: Exception | None) -> None:
        with contextlib.suppress(RuntimeError, pytest.skip.Exception), unless_passed(config, "page", [tmp_path]):
            ran.append(outcome)
            if outcome:
                raise outcome

    failure = RuntimeError("it is not what it says")
    for outcome in (failure, None, None):
        run(outcome)
    assert ran == [failure, None]
    monkeypatch.setenv("CI", "true")
    run(None)
    assert ran == [failure, None, None]


def test_there_are_pages_and_blocks() -> None:
    found = [block for path in PAGES for block in blocks(path.read_text(encoding="utf-8"), path.name)]
    assert len(PAGES) > 20
    assert {"python", "toml", "csv", "sh", "text", "yaml"} <= {block.language for block in found}


BROKEN = re.findall(
    r"^#### (.+?): (.+)\n((?:(?!####).*\n)+)",
    (ROOT / "tests" / "docs" / "broken.txt").read_text(encoding="utf-8"),
    re.MULTILINE,
)
"""Blocks: what is wrong with each, what is said of it, and its text."""


@pytest.mark.parametrize(("said", "text"), [each[1:] for each in BROKEN], ids=[each[0] for each in BROKEN])
def test_a_block_that_is_broken_fails(said: str, text: str, page: Page) -> None:
    with pytest.raises(DocsError) as failed:
        page.follow(f"# A page\n\n{text}", "page.md")
    assert "page.md:3: " in str(failed.value) or "excerpt" in said or "never run" in said
    assert said in str(failed.value)


@pytest.mark.parametrize(
    ("shown", "is_excerpt"),
    [
        ("b\nc", True),
        ("b", True),
        ("a\n…\nd e", True),
        ("…\nd e\n…", True),
        ("d …", True),
        ("a\nc", False),
        ("c\n…\nb", False),
        ("d", False),
    ],
)
def test_an_excerpt_is_told_from_what_is_none(shown: str, is_excerpt: bool) -> None:
    assert shows("a\nb  \nc\nd e\n", shown) is is_excerpt


@pytest.mark.parametrize(
    "workflow",
    [
        {"jobs": {"a": {"runs-on": "x", "steps": [{"run": "make lint"}]}}},
        {"on": "push", "jobs": {"a": {"steps": [{"run": "make lint"}]}}},
        {"on": "push", "jobs": {"a": {"runs-on": "x", "steps": [{"run": "make lint", "uses": "a/b@v1"}]}}},
        {"on": "push", "jobs": {"a": {"runs-on": "x", "steps": [{"uses": "checkout"}]}}},
    ],
    ids=["no trigger", "no machine", "two things at once", "no action"],
)
def test_a_workflow_that_is_none_fails(workflow: dict[str, Any]) -> None:
    with pytest.raises(DocsError):
        check_workflow(workflow)
