"""Reports, the index and comparisons: what stands in the pages, and what must not."""

import json
import os
import re
import shutil
import time
import webbrowser
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import typer
from typer.testing import CliRunner

from emulator.cli import folders as report_cli
from emulator.records.radio_metrics import radio_metrics
from emulator.records.recorded_run import RecordedRun
from emulator.report.comparison import Comparison, comparison_page
from emulator.report.index import write_index
from emulator.report.radio_figures import outcomes_in_bins
from emulator.report.source import Source
from emulator.report.write import key_figures, write_report
from tests.support.command_line import app
from tests.support.forked_commands import NO_CHARTS
from tests.support.paths import ROOT
from tests.support.recorded import recorded
from vnet.errors import VnetError

pytestmark = pytest.mark.slow

EVIL = "<script>alert(1)</script>"


class Page(HTMLParser):
    """The text of a page, its ids, and all that it refers to."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.words: list[str] = []
        self.ids: list[str] = []
        self.references: list[str] = []
        self.tags: list[str] = []
        self.feed(text)
        self.text = " ".join(" ".join(self.words).split())

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        for name, value in attrs:
            if name == "id":
                self.ids.append(value or "")
            if name in ("href", "src", "data", "action"):
                self.references.append(value or "")

    def handle_data(self, data: str) -> None:
        self.words.append(data)


def vnet(arguments: list[str]) -> Any:
    """Run a command in this process; without a fixed hash seed, it would restart itself."""
    return CliRunner(env={"PYTHONHASHSEED": "0"}).invoke(app, arguments)


def simulate(folder: Path, *options: str, scenario: str = "faults.toml") -> Path:
    arguments = ["simulate", str(ROOT / "scenarios" / scenario), "--out", str(folder), *options]
    done = vnet(arguments)
    assert (folder / "verdict.json").exists(), done.output
    return folder


@pytest.fixture(scope="module")
def cooperative(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A short run of the cooperative positioning program."""
    options = ("--duration", "2", "--no-report", "--set", "program.options.particles=50")
    return simulate(tmp_path_factory.mktemp("runs") / "coop", *options, scenario="twelve.toml")


@pytest.fixture(scope="module")
def page(cooperative: Path) -> Page:
    """Its report."""
    return page_of(cooperative)


@pytest.fixture(scope="module")
def beacon_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("beacon") / "runs" / "beacon-1"
    return simulate(folder, "--duration", "2", "--no-report", scenario="beacon.toml")


@pytest.fixture
def beacon(beacon_run: Path, tmp_path: Path) -> Path:
    """A copy that a test may break."""
    return Path(shutil.copytree(beacon_run, tmp_path / "runs" / "beacon-1"))


@pytest.fixture
def no_charts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Write pages without charts, which cost ten times what the rest of a page does."""
    for name, value in NO_CHARTS.items():
        monkeypatch.setattr(f"emulator.pages.canvas.{name}", value)


def page_of(folder: Path) -> Page:
    return Page(write_report(Source(folder)).read_text())


def test_figures_have_axes_with_units_and_are_those_of_the_verdict(cooperative: Path, page: Page) -> None:
    for label in ("common error (m)", "RMSE of position (m)", "emulated time (s)", "latency (ms)", "distance (km)"):
        assert label in page.text
    record = RecordedRun.open(cooperative).record
    assert f"{record.figures['common_error_rmse_m']:.3f} m" in page.text
    for name, value in key_figures(record).items():
        assert f"{name} {value}" in page.text
    assert record.trace_sha256 in page.text and record.reproduce in page.text
    assert "common-error" in page.ids and len(page.ids) == len(set(page.ids))


def test_a_report_needs_nothing_from_elsewhere(cooperative: Path, page: Page) -> None:
    assert page.references and all(reference.startswith("#") for reference in page.references)
    assert page.tags.count("script") == 1 and "timeline" in page.ids
    assert "url(http" not in (cooperative / "report.html").read_text()


def test_a_figure_with_nothing_to_show_is_left_out_with_the_reason(beacon: Path) -> None:
    page = page_of(beacon)
    assert "common-error" not in page.ids and "latency" in page.ids
    assert not {"position", "consensus", "consistency", "weights", "busy"} & set(page.ids)
    for word in ("Common error", "Not shown", "ANEES", "RMSE"):
        assert word not in page.text, "nothing is said of what the program does not do"


@pytest.mark.usefixtures("no_charts")
def test_checks_that_failed_come_first(beacon: Path) -> None:
    verdict = json.loads((beacon / "verdict.json").read_text())
    verdict["verdict"] = verdict["checks"][0]["verdict"] = "invalid"
    (beacon / "verdict.json").write_text(json.dumps(verdict))
    page = page_of(beacon)
    assert page.ids.index("problems") < page.ids.index("program") < page.ids.index("checks")
    first = page.text[page.text.index("What is not valid ✗") :]
    assert first.split("Reported by the program")[0].count("valid") == 2, "the checks that are valid come later"


def test_a_shared_medium_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = simulate(
        tmp_path / "run", "--duration", "1.5", "--no-report", "--set", "network.vehicles=20", scenario="80211p.toml"
    )
    page = page_of(run)
    assert "channel busy ratio (%)" in page.text and "expected: " not in page.text
    figures = radio_metrics(RecordedRun.open(run))
    delivered, busy = figures.totals["delivery_ratio"], figures.totals["busy_ratio_mean"]
    assert delivered is not None and busy is not None
    assert f"packet delivery ratio {100 * delivered:.1f} %" in page.text
    assert f"channel busy ratio {100 * busy:.1f} %" in page.text
    assert f"age of information {figures.totals['age_mean_ms']:.1f} ms" in page.text
    worst = figures.worst_links(1).to_pylist()[0]
    assert f"{worst['sender']} {worst['receiver']} {worst['pairs']}" in page.text
    assert "time (ms)" in page.text and "all frames, by 200 m" in page.text
    assert "busy" in page.ids
    (run / "busy.parquet").unlink()
    for name, value in NO_CHARTS.items():
        monkeypatch.setattr(f"emulator.pages.canvas.{name}", value)
    without = page_of(run)
    assert "busy" not in without.ids
    assert re.search(r"Not shown .*Channel busy ratio.*: .*no busy\.parquet in it", without.text)
    assert "age of information" in without.text, "the rest of the radio's figures stay"


def test_a_fault_that_delays_takes_nothing_from_the_share_that_is_delivered(tmp_path: Path) -> None:
    delay = {"kind": "delay", "at_s": 0.5, "duration_s": 0.5, "delay_ms": 700.0}
    scenario = {
        "run": {"duration_s": 2.0, "settle_s": 0.0},
        "network": {"vehicles": 4},
        "radio": {"range_m": 1e6, "loss": 0.3},
        "program": {"entry": "agents.beacon:main"},
        "fault": [delay],
    }
    late = Source(recorded(scenario, tmp_path / "late"))
    punctual = Source(recorded(scenario | {"fault": []}, tmp_path / "punctual"))
    names, counts = outcomes_in_bins(late, late.trace, 100_000_000)
    assert counts.shape == (20, len(names)) and counts.sum() == len(late.trace)
    assert counts.tolist() == outcomes_in_bins(punctual, punctual.trace, 100_000_000)[1].tolist()


def test_what_others_wrote_is_text(beacon: Path) -> None:
    verdict = json.loads((beacon / "verdict.json").read_text())
    check = {"name": EVIL, "verdict": "invalid", "text": EVIL, "figures": {"rows": [{"sender": EVIL}], EVIL: EVIL}}
    verdict["checks"].append(check)
    verdict["reproduce"] = EVIL
    (beacon / "verdict.json").write_text(json.dumps(verdict))
    with (beacon / "events.jsonl").open("a") as events:
        events.write(json.dumps({"time_ns": 1, "kind": "crashed", "node": EVIL, "error": EVIL}) + "\n")
    (beacon / "scenario.toml").write_text((beacon / "scenario.toml").read_text() + f"# {EVIL}\n")
    evil = beacon.rename(beacon.with_name("<img src=x>"))
    text = write_report(Source(evil)).read_text()
    index = write_index(evil.parent).read_text()
    assert EVIL not in text and "<img" not in text + index
    page = Page(text)
    assert page.tags.count("script") == 1 and page.text.count(EVIL) >= 7
    assert "the first offending rows" in page.text


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize(
    "lost", ["trace.parquet", "states.parquet", "metrics.parquet", "verdict.json", "events.jsonl"]
)
def test_a_run_that_lost_a_file_has_a_report_that_says_so(beacon: Path, lost: str) -> None:
    (beacon / lost).unlink()
    page = page_of(beacon)
    assert lost.removesuffix(".parquet") in page.text
    if lost == "verdict.json":
        assert "no verdict" in page.text and "No check was judged" in page.text


@pytest.mark.usefixtures("no_charts")
def test_a_verdict_that_cannot_be_read_is_not_taken_for_a_run_that_goes_on(beacon: Path) -> None:
    (beacon / "verdict.json").write_text("{")
    page = page_of(beacon)
    assert "The verdict of this run cannot be read." in page.text and "still going on" not in page.text
    assert "verdict.json: not JSON" in page.text


def test_what_a_program_reports_is_a_column_of_the_index(beacon: Path) -> None:
    page = Page(write_index(beacon.parent).read_text())
    figure = RecordedRun.open(beacon).record.reported["neighbours"]
    _, mean, spread, _ = figure.words("neighbours")
    assert "neighbours" in page.text and mean in page.words and spread in page.words
    assert "RMSE (m)" not in page.text, "the program knows nothing of a common error"


@pytest.mark.usefixtures("no_charts")
def test_the_index_lists_broken_and_half_written_runs_and_latest_once(beacon: Path) -> None:
    runs = beacon.parent
    (runs / "latest").symlink_to("beacon-1")
    (runs / "broken-1").mkdir()
    (runs / "broken-1" / "verdict.json").write_text("{")
    (runs / "half-1").mkdir()
    shutil.copy(beacon / "scenario.toml", runs / "half-1")
    (runs / "notes").mkdir()
    write_report(Source(beacon))
    page = Page((runs / "index.html").read_text())
    assert "3 runs" in page.text and "notes" not in page.text
    assert page.text.count("beacon-1") == 1 and "beacon-1 · latest" in page.text.replace("  ", " ")
    assert "broken verdict.json: not JSON" in page.text.replace("broken-1 ", "broken ", 1)
    assert "no verdict.json: it is still going on" in page.text
    assert "./beacon-1/report.html" in page.references and "./half-1/" in page.references
    assert not list(runs.glob(".*.part"))
    share = RecordedRun.open(beacon).record.packet_delivery_ratio
    assert share is not None and f"{100 * share:.2f}" in page.text


@pytest.mark.parametrize("zone", ["UTC+24", "UTC-24", "XYZ-5:30"])
def test_a_zone_a_day_away_from_utc_is_none_for_the_index(
    zone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "another-1").mkdir()
    (tmp_path / "another-1" / "verdict.json").write_text("{")
    os.utime(tmp_path / "another-1" / "verdict.json", (0, 0))
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        page = write_index(tmp_path).read_text()
    finally:
        monkeypatch.undo()
        time.tzset()
    assert ("1970-01-01 05:30" if zone == "XYZ-5:30" else "1970-01-01 00:00") in page


def test_a_run_that_cannot_be_entered_is_a_row_of_the_index_and_hides_no_other(tmp_path: Path) -> None:
    for name in ("another-1", "closed-1"):
        (tmp_path / name).mkdir()
    (tmp_path / "another-1" / "verdict.json").write_text("{")
    (tmp_path / "closed-1" / "scenario.toml").symlink_to("n" * 300)  # which root, too, cannot read
    page = Page(write_index(tmp_path).read_text())
    assert "2 runs" in page.text and "broken" in page.text
    assert "cannot be read: File name too long" in page.text and "./closed-1/" in page.references


@pytest.mark.usefixtures("no_charts")
def test_simulate_writes_the_report_and_a_failure_leaves_the_verdict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenario = str(ROOT / "scenarios" / "beacon.toml")
    arguments = ["simulate", scenario, "--duration", "2", "--out"]
    written = vnet([*arguments, str(tmp_path / "one")])
    assert (tmp_path / "one" / "report.html").exists() and "report.html" in written.output.replace("\n", "")

    def fail(folder: Path) -> Path:
        raise RuntimeError("no ink")

    monkeypatch.setattr(report_cli, "_write_report", fail)
    failed = vnet([*arguments, str(tmp_path / "two")])
    assert failed.exit_code == written.exit_code == 0
    assert "the report could not be written" in failed.output and "no ink" in failed.output
    left_out = vnet([*arguments, str(tmp_path / "three"), "--no-report"])
    assert left_out.exit_code == 0 and "could not be written" not in left_out.output


def test_compare_finds_a_planted_difference(beacon_run: Path, beacon: Path, tmp_path: Path) -> None:
    same = vnet(["compare", str(beacon_run), str(beacon)])
    assert same.exit_code == 0 and "two runs agree" in same.output
    trace = pq.read_table(beacon / "trace.parquet")
    size = trace["size_bytes"].to_pylist()
    size[7] += 1
    place = trace.column_names.index("size_bytes")
    planted = trace.set_column(place, "size_bytes", pa.array(size, trace.schema.field(place).type))
    pq.write_table(planted, beacon / "trace.parquet")
    out = tmp_path / "both.html"
    done = vnet(["compare", str(beacon_run), str(beacon), "--out", str(out)])
    assert done.exit_code == 1
    assert "first in row 7 of the trace: size_bytes" in done.output
    page = Page(out.read_text())
    assert "first in row 7 of the trace: size_bytes" in page.text
    assert f", {size[7]} bytes, digest" in page.text
    assert "latency (ms)" in page.text
    assert all(reference.startswith("#") for reference in page.references)


def test_compare_says_which_keys_differ_and_by_how_much(cooperative: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(cooperative, tmp_path / "other"))
    text = (other / "scenario.toml").read_text()
    (other / "scenario.toml").write_text(text.replace("seed = 1\n", "seed = 5\n", 1))
    verdict = json.loads((other / "verdict.json").read_text())
    verdict["figures"]["common_error_rmse_m"] += 0.25
    (other / "verdict.json").write_text(json.dumps(verdict))
    comparison = Comparison.of(cooperative, other)
    assert comparison.same_trace
    assert comparison.scenario == [{"key": "run.seed", "A": "1", "B": "5"}]
    assert comparison.figures[0]["B − A"] == "+0.250"
    page = Page(comparison_page(comparison))
    assert "RMSE of the common error (m)" in page.text and "run.seed 1 5" in page.text


def test_compare_ends_with_1_where_only_reported_values_part(cooperative: Path, tmp_path: Path) -> None:
    other = Path(shutil.copytree(cooperative, tmp_path / "other"))
    states = pq.read_table(other / "states.parquet")
    heard = [value and value + 1 for value in states["heard"].to_pylist()]
    planted = states.set_column(states.column_names.index("heard"), "heard", pa.array(heard, pa.float64()))
    pq.write_table(planted, other / "states.parquet")
    done = vnet(["compare", str(cooperative), str(other)])
    assert done.exit_code == 1 and "a value of v" in done.output
    parting = Comparison.of(cooperative, other).partings[0]
    first = next(value for value in states["heard"].to_pylist() if value)
    assert parting["A"] == f"heard = {first}" and parting["B"] == f"heard = {first + 1}"


def test_compare_shows_where_runs_with_other_columns_part(beacon_run: Path, beacon: Path) -> None:
    trace = pq.read_table(beacon / "trace.parquet")
    power = pa.array([-60.0] * len(trace), pa.float32())
    pq.write_table(trace.append_column("rssi_dbm", power), beacon / "trace.parquet")
    done = vnet(["compare", str(beacon_run), str(beacon)])
    assert done.exit_code == 1 and "first in row 0 of the trace: rssi_dbm" in done.output


@pytest.mark.usefixtures("no_charts")
def test_a_report_of_an_unfinished_run_says_so(beacon: Path, tmp_path: Path) -> None:
    finished = vnet(["report", str(beacon)])
    unfinished = tmp_path / "unfinished"
    shutil.copytree(beacon, unfinished)
    (unfinished / "verdict.json").unlink()
    done = vnet(["report", str(unfinished)])
    assert (finished.exit_code, finished.stderr) == (0, "")
    assert done.stdout == f"{unfinished / 'report.html'}\n"
    assert done.stderr == (
        f"vnet: note: {unfinished}: has no verdict: the run is still going on, or was ended from outside\n"
    )


@pytest.mark.usefixtures("no_charts")
def test_a_run_that_ended_in_its_first_period_has_a_report(beacon: Path) -> None:
    for name in ("states", "metrics", "trace"):
        path = beacon / f"{name}.parquet"
        pq.write_table(pq.read_table(path).slice(0, 0), path)
    page = page_of(beacon)
    assert "no period was completed, and no position is known" in page.text


def test_compare_refuses_an_unfinished_run(beacon_run: Path, beacon: Path) -> None:
    (beacon / "states.parquet").unlink()
    with pytest.raises(VnetError, match=r"states\.parquet"):
        Comparison.of(beacon_run, beacon)


@pytest.mark.usefixtures("no_charts")
@pytest.mark.parametrize("damaged", ["trace.parquet", "states.parquet", "scenario.toml"])
def test_report_of_a_damaged_run_bears_no_verdict_and_ends_with_an_error(
    beacon: Path, damaged: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(webbrowser, "open", lambda uri: False)
    content = (beacon / damaged).read_bytes()
    (beacon / damaged).write_bytes(content[: len(content) // 2])
    assert "The verdict, valid, stood on files that cannot be read" in page_of(beacon).text
    with pytest.raises(typer.Exit) as ended:
        report_cli.report(beacon, show=True)
    assert ended.value.exit_code == 2 and damaged.split(".")[0] in capsys.readouterr().err
