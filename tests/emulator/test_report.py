"""A run's report, the index of runs, and two runs compared, read back as a browser would."""

import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from emulator.cli import app
from emulator.observe.report.comparison import Comparison
from emulator.observe.report.index import write_index
from emulator.observe.report.write import write_report
from emulator.observe.run_folder import RunFolder
from emulator.run.conclude import conclude
from emulator.run.emulation import Emulation
from emulator.run.simulate import simulate
from emulator.world.world import build_world
from vnet.errors import VnetError
from vnet.link.node import Node
from vnet.scenario import Scenario

TITLES = (
    *(
        "Common error",
        "Position",
        "Outcomes over time",
        "Outcomes in total",
        "Delivery against distance",
        "Latency",
    ),
    *("Consensus error", "Consistency of the filters", "Degrees of the network", "Fusion weights"),
)
FAULTS = [
    {"kind": "loss", "at_s": 0.5, "duration_s": 1.0, "probability": 0.5},
    {"kind": "kill", "at_s": 1.0, "duration_s": 0.5, "nodes": {"ids": ["v01"]}},
]


async def fails(node: Node) -> None:
    """End with an error whose text would do harm in a page."""
    async for _ in node.gnss:
        raise RuntimeError("<script>alert(1)</script> & quotes")


class Page(HTMLParser):
    """What a page holds: texts by element, tags, and what it refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.references: list[str] = []
        self.headings: list[str] = []
        self.text: list[str] = []
        self._stack: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self._stack.append(tag)
        self.references += [value or "" for name, value in attrs if name in ("src", "href", "xlink:href")]

    def handle_endtag(self, tag: str) -> None:
        while self._stack and self._stack.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if "style" not in self._stack and "script" not in self._stack:
            self.text.append(data)
        if self._stack and self._stack[-1] in ("h1", "h2", "h3"):
            self.headings.append(data.strip())

    @property
    def words(self) -> str:
        """All text, with single spaces."""
        return " ".join(" ".join(self.text).split())


def run(folder: Path, **sections: object) -> Path:
    """A simulated run, concluded."""
    scenario = Scenario.model_validate(
        {
            "run": {"duration_s": 5.0, "settle_s": 1.0},
            "network": {"vehicles": 5},
            "radio": {"loss": 0.1},
            **sections,
        }
    )
    emulation = Emulation(scenario, build_world(scenario), RunFolder.create(folder, scenario))
    wall_s, _ = simulate(emulation)
    conclude(emulation, wall_s, "simulate")
    return folder


@pytest.fixture(scope="module")
def cooperative(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the flagship under faults."""
    program = {"entry": "agents.cooperative:main", "options": {"particles": 30}}
    return run(tmp_path_factory.mktemp("runs") / "coop", program=program, fault=FAULTS)


def page_of(folder: Path) -> Page:
    return Page(write_report(folder).read_text())


def test_a_report_has_verdict_checks_figures_scenario_and_command(cooperative: Path) -> None:
    text = write_report(cooperative).read_text()
    page = Page(text)
    verdict = json.loads((cooperative / "verdict.json").read_text())
    assert verdict["verdict"] in page.words
    for check in verdict["checks"]:
        assert check["name"] in page.words
        assert " ".join(check["text"].split()) in page.words
    assert f"{verdict['figures']['common_error_rmse_m']:.3f} m" in page.words
    assert [title for title in TITLES if title not in page.headings] == []
    for part in (
        "loss-0",
        "kill-1",
        verdict["trace_sha256"],
        verdict["reproduce"],
        'entry = "agents.cooperative:main"',
    ):
        assert part in page.words, part
    assert text.index('id="checks"') < text.index('id="figures"') < text.index('id="scenario"')


def test_every_figure_has_axes_with_units(cooperative: Path) -> None:
    words = page_of(cooperative).words
    for label in (
        *("emulated time (s)", "common error (m)", "RMSE of position (m)", "share of pairs (%)", "distance (km)"),
        *("delivered (%)", "latency (ms)", "consensus error (m)", "others in range (vehicles)", "ANEES"),
    ):
        assert label in words, label


def test_a_page_needs_nothing_from_elsewhere_and_knows_dark(cooperative: Path) -> None:
    text = write_report(cooperative).read_text()
    page = Page(text)
    assert all(reference.startswith("#") for reference in page.references)
    assert not {"script", "link", "img", "iframe"} & set(page.tags)
    assert "prefers-color-scheme: dark" in text
    assert 'name="viewport"' in text
    assert "var(--ink" in text[text.index("<svg") :]
    assert len(text) < 1_500_000


def test_what_others_wrote_is_text_and_nothing_else(tmp_path: Path) -> None:
    folder = run(tmp_path / "<b>bad", program={"entry": f"{__name__}:fails"})
    page = page_of(folder)
    assert "script" not in page.tags
    assert "<script>alert(1)</script>" in page.words
    assert "<b>bad" in page.words
    assert "invalid" in page.words


def test_a_beacon_alone_has_a_report_that_says_what_is_missing(tmp_path: Path) -> None:
    page = page_of(run(tmp_path / "one", network={"vehicles": 1}))
    assert "no program reported what it needs" in page.words
    assert "no frame was sent to anybody in range" in page.words
    assert "Common error" not in page.headings


@pytest.mark.parametrize(
    "gone", ["trace.parquet", "states.parquet", "metrics.parquet", "events.jsonl", "verdict.json"]
)
def test_what_is_left_of_a_run_is_shown(cooperative: Path, tmp_path: Path, gone: str) -> None:
    folder = shutil.copytree(cooperative, tmp_path / "left")
    (folder / gone).unlink()
    assert "Have it again" in page_of(folder).headings


def test_a_folder_that_is_no_runs_has_no_report(tmp_path: Path) -> None:
    with pytest.raises(VnetError, match="not a run's folder"):
        write_report(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_the_index_lists_every_run_once_the_broken_ones_too(cooperative: Path, tmp_path: Path) -> None:
    runs = tmp_path / "runs"
    shutil.copytree(cooperative, runs / "good")
    (runs / "latest").symlink_to("good")
    half = shutil.copytree(cooperative, runs / "half")
    (half / "verdict.json").write_text("{")
    (runs / "no-run").mkdir()
    write_report(runs / "good")
    page = Page((runs / "index.html").read_text())
    names = [reference for reference in page.references if "good" in reference]
    assert names and not any("latest/" in reference for reference in page.references)
    assert page.words.count("good") == 1
    assert "half" in page.words
    verdict = json.loads((runs / "good" / "verdict.json").read_text())
    assert f"{verdict['figures']['common_error_rmse_m']:.3f}" in page.words
    assert write_index(runs).read_text() == (runs / "index.html").read_text()


def test_two_runs_are_compared_and_part_where_they_do(cooperative: Path, tmp_path: Path) -> None:
    program = {"entry": "agents.cooperative:main", "options": {"particles": 30}}
    other = run(tmp_path / "other", program=program, fault=FAULTS, radio={"loss": 0.3})
    comparison = Comparison.of(cooperative, other)
    assert not comparison.same_trace
    assert ("radio.loss", "0.1", "0.3", "") in comparison.scenario_rows()
    (rmse,) = [row for row in comparison.figure_rows() if row[0] == "common error, RMSE"]
    ours, theirs, change = (float(cell.split()[0]) for cell in rmse[1:])
    assert change == pytest.approx(theirs - ours, abs=0.0011)
    figures = comparison.first_difference.figures  # type: ignore[union-attr]
    assert figures["table"] == "trace"
    assert "outcome" in figures["differing"]


def test_compare_answers_as_diff_does(cooperative: Path, tmp_path: Path) -> None:
    same = shutil.copytree(cooperative, tmp_path / "same")
    other = run(tmp_path / "other", run={"duration_s": 2.0})
    page = tmp_path / "two.html"
    done = CliRunner().invoke(app, ["compare", str(cooperative), str(same), "--out", str(page)])
    assert done.exit_code == 0, done.output
    assert "two runs agree" in done.output
    assert "common error (m)" in Page(page.read_text()).words
    assert CliRunner().invoke(app, ["compare", str(cooperative), str(other)]).exit_code == 1
    assert CliRunner().invoke(app, ["compare", str(cooperative), str(tmp_path)]).exit_code == 2
