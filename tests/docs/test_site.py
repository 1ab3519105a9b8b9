"""The documentation's site: it is built without a warning, shows every page, and needs nothing from elsewhere."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.docs.markdown import PAGES, anchors, links
from tests.docs.once import unless_passed
from tests.support.paths import ROOT


@pytest.fixture(scope="module")
def configuration() -> ModuleType:
    spec = importlib.util.spec_from_file_location("site_configuration", ROOT / "docs" / "site" / "conf.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_contents_follow_the_index(configuration: ModuleType) -> None:
    index = "# All\n\n**First**\n\n- [a](a.md#part), [b](how-to/b.md)\n\n**Second**: more\n\n- [c](../C.md)\n"
    first, second = configuration.contents(index).split("\n\n```{toctree}")
    assert ":caption: First\n\na.md\nhow-to/b.md\n```" in first
    assert ":caption: Second\n\n../C.md\n```" in second


@pytest.mark.slow
def test_the_site_has_every_page_and_loads_nothing_from_elsewhere(
    tmp_path: Path, pytestconfig: pytest.Config
) -> None:
    """All pages are read and their links resolved; two are written, with the theme that all have."""
    sources = [file for name in ("vnet", "agents", "emulator", "docs") for file in (ROOT / name).rglob("*.*")]
    with unless_passed(pytestconfig, "site", [*PAGES, *sources]):
        read, site, written = tmp_path / "read", tmp_path / "site", ("docs/index.md", "docs/python.md")
        for options, pages in ((["-W", "-b", "dummy"], ()), (["-Q", "-b", "html"], written)):
            words = [*options, "-q", "-d", str(read), "-c", "docs/site", ".", str(site), *pages]
            subprocess.run([sys.executable, "-m", "sphinx", *words], cwd=ROOT, check=True)
        for page in PAGES:
            assert (read / page.relative_to(ROOT).with_suffix(".doctree")).exists(), page
        html = {name: (site / name).with_suffix(".html").read_text(encoding="utf-8") for name in written}
        loaded = re.compile(
            r"""<(?:script|img|iframe)[^>]*\ssrc="(?:https?:)?//|<link[^>]*\shref="(?:https?:)?//|!\[[^]]*\]\(https?:"""
        )
        texts = {str(page): page.read_text(encoding="utf-8") for page in PAGES}
        assert [path for path, text in {**html, **texts}.items() if loaded.search(text)] == []
        assert "broadcast" in html["docs/python.md"]


def broken(path: Path, text: str) -> list[str]:
    """The links of a page, within the repository, that lead nowhere."""
    found = []
    for link in links(text):
        file, _, anchor = link.partition("#")
        if "://" in link or file.startswith("mailto:"):
            continue
        target = (path.parent / file).resolve() if file else path
        page = text if target == path else target.read_text() if target.suffix == ".md" and target.exists() else ""
        if not (target == path or target.exists()) or (anchor and anchor not in anchors(page)):
            found.append(link)
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_link_leads_nowhere(path: Path) -> None:
    assert broken(path, path.read_text(encoding="utf-8")) == []


def test_a_link_that_leads_nowhere_is_found() -> None:
    text = "# One thing\n\n[a](README.md) [b](nowhere.md) [c](#one-thing) [d](#another) ![e](docs/no.png) [f](https://x.y)"
    assert broken(ROOT / "page.md", text) == ["nowhere.md", "#another", "docs/no.png"]


def test_every_page_is_in_the_index() -> None:
    index = ROOT / "docs" / "index.md"
    linked = {(index.parent / link.partition("#")[0]).resolve() for link in links(index.read_text())}
    assert set(PAGES) - linked == {index}


def test_the_readme_is_short() -> None:
    assert len((ROOT / "README.md").read_text().splitlines()) < 150
