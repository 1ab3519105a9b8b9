"""The documentation's site: it is built without a warning, shows every page, and needs nothing from elsewhere."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

from tests.docs.markdown import PAGES
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
    sources = [file for name in ("vnet", "agents", "emulator", "docs") for file in (ROOT / name).rglob("*.*")]
    with unless_passed(pytestconfig, "site", [*PAGES, *sources]):
        folders = [str(tmp_path / "cache"), "-c", "docs/site", ".", str(tmp_path / "site")]
        subprocess.run([sys.executable, "-m", "sphinx", "-q", "-W", "-d", *folders], cwd=ROOT, check=True)
        site = tmp_path / "site"
        for page in PAGES:
            assert (site / page.relative_to(ROOT).with_suffix(".html")).exists(), page
        pages = {path: path.read_text(encoding="utf-8") for path in site.rglob("*.html")}
        loaded = re.compile(
            r"""<(?:script|img|iframe)[^>]*\ssrc="(?:https?:)?//|<link[^>]*\shref="(?:https?:)?//"""
        )
        assert [path for path, text in pages.items() if loaded.search(text)] == []
        assert "broadcast" in pages[site / "docs" / "python.html"]
        assert "lockstep" in (site / "searchindex.js").read_text(encoding="utf-8")
