"""Pages escape, cut and make printable what others wrote, and their templates are shipped."""

import logging
import os
import re
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable, Sequence
from html.parser import HTMLParser
from pathlib import Path

import pytest
from jinja2 import UndefinedError
from markupsafe import Markup

from emulator.pages.canvas import FaultSpan, canvas, legend, styled, to_svg
from emulator.pages.page import render, table
from emulator.pages.text import LONGEST_TEXT, as_text, cell
from emulator.records.verdicts import Verdict
from emulator.report.drawing import Chart
from emulator.report.timeline import Timeline
from emulator.testing.campaign import page as campaign_page
from tests.support.paths import ROOT

TEMPLATES = ROOT / "emulator" / "pages" / "templates"
MARKUP = "<script>alert(1)</script>"
ATTRIBUTE = '"><img src=x onerror="alert(1)'
CONTROLS = "a\x00b\x1b[31mc\u202ed\u2028e\udcff\r"
LONG = "<b>" * 350_000
HOSTILE = [MARKUP, ATTRIBUTE, "' onmouseover='alert(1)", "{{ 7 * 7 }}{% include 'style.css' %}", "</style></title>",
           "&lt;&amp;", CONTROLS, LONG]  # fmt: skip


class Elements(HTMLParser):
    """Count each element of a page, its attributes, and its text."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: Counter[str] = Counter()
        self.attributes: Counter[str] = Counter()
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags[tag] += 1
        self.attributes.update(name for name, _ in attrs)

    def handle_data(self, data: str) -> None:
        self.text += data


def campaign(text: str) -> str:
    """A campaign's page with a text wherever others may have written it."""
    failure = dict.fromkeys(("number", "seed", "schedule", "order", "command", "folder"), text) | {
        "checks": {text: text},
        "parting": {"line": text, "rows": table([{text: text}]), "node": text, "until": [text, text]},
    }
    return campaign_page(text, [text], {text: {text: Counter({Verdict.INVALID: 1})}}, [failure])


@styled()
def drawing(label: str) -> Markup:
    """A picture without anything in it."""
    return to_svg(canvas("x", "y").figure, "key", label)


def test_a_text_that_is_no_xml_is_drawn() -> None:
    with styled():
        drawn = to_svg(canvas("lane\x00 \x1b[31m \ufffe", "y").figure, "key", "label")
    assert "lane\ufffd \ufffd[31m \ufffd" in drawn


def comparison(text: str) -> str:
    """A comparison with a text wherever others may have written it."""
    run = {"letter": "A", "name": text, "folder": Path(text), "verdict": Verdict.VALID}
    rows = table([{text: text, "number": 1.0}], text)
    return render(
        "comparison.html.j2",
        runs=[run, run],
        difference=text,
        partings=rows,
        scenario=rows,
        key_figures=rows,
        reported=rows,
        outcomes=rows,
        checks=rows,
        charts=[Chart("key", text, drawing(text), text)],
        missing={text: [text, text]},
    )


def failure(text: str) -> str:
    """A failure's page with a text wherever others may have written it."""
    parting = {"line": text, "rows": table([{text: text}]), "node": text, "until": [text, text]}
    timeline = Timeline(text[:LONGEST_TEXT], text, [(text, "ink", "1")], [("event", "◆", "blue", text, "1")], True)
    return render("failure.html.j2", title=text, checks={text: text}, parting=parting, timeline=timeline)


@pytest.mark.slow
@pytest.mark.parametrize("make", [campaign, comparison, failure])
@pytest.mark.parametrize("text", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_text_adds_no_element_no_attribute_and_no_control(make: Callable[[str], str], text: str) -> None:
    plain, page = Elements(make("plain")), make(text)
    hostile = Elements(page)
    assert hostile.tags == plain.tags
    assert hostile.attributes == plain.attributes
    assert not re.search(r"[\x00-\x08\x0b-\x1f\x7f\u202e\u2028\ud800-\udfff]", page)
    assert len(page) < 100 * LONGEST_TEXT, "some twenty texts, cut, and longer as markup"


def test_text_that_others_wrote_is_read_as_they_wrote_it() -> None:
    page = Elements(campaign(MARKUP))
    assert page.text.count(MARKUP) >= 8
    assert "a\\x00b\\x1b[31mc\\u202ed\\u2028e\\udcff\\r" in Elements(campaign(CONTROLS)).text


def test_as_text() -> None:
    assert as_text("a\tb\nc") == "a\tb\nc"
    assert as_text(None) == "" and as_text(0) == "0" and as_text(1.5) == "1.5"
    assert len(as_text(LONG)) == LONGEST_TEXT and as_text(LONG).endswith("…")
    assert as_text("abcdef", 4) == "abc…" and as_text("abcd", 4) == "abcd"
    assert as_text(Markup("<b>") * 20_000) == "<b>" * 20_000, "a page's own markup is whole"
    assert cell(0.123456789) == "0.123457" and cell(None) == "" and cell("x") == "x"


def test_a_value_that_is_missing_is_an_error_and_not_an_empty_page() -> None:
    with pytest.raises(UndefinedError):
        render("campaign.html.j2", title="t", facts=[], columns=[], kinds={})


def test_templates_mark_nothing_as_safe_and_load_nothing() -> None:
    for path in TEMPLATES.iterdir():
        text = path.read_text()
        assert not re.search(r"\|\s*safe\b|autoescape|Markup|xmlattr", text), path.name
        assert not re.search(r"https?:|//[a-z]|@import|url\(", text), path.name


def test_a_program_that_logs_all_gets_nothing_of_the_drawing(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG):
        logging.getLogger("matplotlib.font_manager").debug("findfont: score")
        logging.getLogger("theirs").debug("said")
    assert caplog.messages == ["said"]


@pytest.mark.slow
def test_nothing_is_printed_where_the_home_cannot_be_written() -> None:
    """Standard error may be for JSON alone; a process of its own, as pytest takes what is logged."""
    words = [sys.executable, "-c", "import emulator.pages.canvas, matplotlib.font_manager"]
    environment = {**os.environ, "MPLCONFIGDIR": "/dev/null"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_every_file_of_the_packages_is_shipped() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    data = project["tool"]["setuptools"]["package-data"]
    patterns = [(ROOT / Path(*package.split(".")), glob) for package, globs in data.items() for glob in globs]
    shipped = {path for folder, pattern in patterns for path in folder.glob(pattern)}
    files = (path for name in ("vnet", "agents", "emulator") for path in (ROOT / name).rglob("*"))
    others = {path for path in files if path.is_file() and path.suffix not in (".py", ".pyc")}
    assert others and others <= shipped
    marked = {folder for folder, pattern in patterns if pattern == "py.typed" and (folder / pattern).is_file()}
    assert marked == {ROOT / name for name in ("vnet", "agents", "emulator")}, "all of them have types"


@pytest.mark.parametrize("labels", ["a", "abcdefg", ["fifteen letters"] * 4, ["x" * 30] * 4, ["x" * 20, "y"] * 5])
def test_a_legend_stands_between_the_axes_and_the_edges_of_its_figure(labels: Sequence[str]) -> None:
    with styled():
        made = canvas("x", "y", [FaultSpan("jamming", 1.0, 2.0)], 3.0)
        below = made.axes.get_window_extent().size
        for label in labels:
            made.axes.plot([0, 1], label=label)
        legend(made)
        made.figure.draw_without_rendering()
    (drawn,) = made.figure.legends
    place, whole = drawn.get_window_extent(), made.figure.bbox
    assert place.y0 >= max(axes.get_window_extent().y1 for axes in made.figure.axes) - 0.5
    assert place.x0 >= 0 and place.x1 <= whole.x1 and place.y1 <= whole.y1 + 0.5
    assert made.axes.get_window_extent().size == pytest.approx(below), "the figure grows, its axes do not"
