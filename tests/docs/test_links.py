"""The pages hang together: no link leads nowhere, and every page is found from the index."""

from pathlib import Path

import pytest

from tests.docs.markdown import PAGES, anchors, links
from tests.support.paths import ROOT


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
