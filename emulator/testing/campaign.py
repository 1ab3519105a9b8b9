"""A campaign: many runs of one scenario under random faults; failures are shrunk, explained and kept.

Run number i has the seed of the campaign plus i. The seed draws the network (if it is generated), the run and the
schedule, so that it alone reproduces a failure. No failure stops a campaign, nor does a full disk; Ctrl-C keeps all
finished runs.

A failure that was seen before may be believed fixed after n green runs. If a run fails with probability p, n runs
pass by chance with (1 - p)^n. That is at most alpha from n = ln(alpha) / ln(1 - p) on. The earlier campaign gives p
by its lower confidence bound (Clopper and Pearson 1934, one-sided): the rate itself would promise too much
after few failures.

A failing run, shrunk, is compared with the run that is most like it and passes: the same in FIFO order, else
without faults, else with the seed of the nearest run of the campaign that has passed, else that run itself.
"""

from __future__ import annotations

import json
import math
import re
import shlex
import signal
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from itertools import count, takewhile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from emulator.checks.own import PREFIX
from emulator.pages.page import put_page, render, table
from emulator.records.disk import DiskError, check_is_free, disk_errors, room_held, write_atomically
from emulator.records.distributions import lowest_share
from emulator.records.parting import Parting, before, partings
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run_folder import RUNS, SCENARIO_FILE
from emulator.records.verdicts import WORST_FIRST, Verdict
from emulator.report.index import CAMPAIGN_FILE, CAMPAIGN_PAGE, read_campaign, write_index
from emulator.report.source import Source, maybe
from emulator.report.timeline import timeline
from emulator.scenario.loading import dump_scenario, load_scenario
from emulator.scenario.scenario import Scenario
from emulator.testing.campaign_plan import Plan, with_seed
from emulator.testing.trial import (
    EMULATOR,
    GROWTH,
    HUNG,
    MOST_ORDER_STEPS,
    MOST_STEPS,
    REFUSED,
    REPLAY,
    UNKNOWN,
    Schedule,
    Trial,
    TrialPool,
    order_text,
    shrink,
    shrink_order,
    shrink_run,
    with_faults,
    with_tape,
)
from vnet.errors import VnetError, counted, printable
from vnet.units import NS_PER_S

PARTING_FILE = "parting.txt"
LONGEST = 300
"""Characters of what a run has at a parting."""


@dataclass(frozen=True)
class Explanation:
    """Differences of a failing run and one that passes; or the reason why it was compared with none."""

    passing: str = ""
    """The run that passes, as a phrase; "" if there is none."""
    partings: tuple[Parting, ...] = ()
    """The first difference of each kind, the earliest first; `first` is of the run that passes."""
    until: tuple[str, ...] = ()
    """Lines on what had happened to the vehicle of the first difference, in the run that fails."""
    why_not: str = ""
    """Reason why there is nothing to tell; "" if there is."""

    def line(self) -> str:
        """Return the first difference in one line."""
        if self.why_not:
            return f"was not compared: {self.why_not}"
        if not self.partings:
            return f"agrees with {self.passing} in all that is recorded"
        first = self.partings[0]
        return (
            f"parts from {self.passing} at {_seconds(first.time_ns)} s by the {first.kind} of {first.node}: "
            f"{_shown(first, first.second)}; there: {_shown(first, first.first)}"
        )

    def rows(self) -> list[dict[str, str]]:
        """Return a row for each kind of difference, the earliest first, as tables show them."""
        return [
            {
                "time (s)": _seconds(each.time_ns),
                "first": each.kind,
                "vehicle": each.node,
                "in the run that passes": _shown(each, each.first),
                "in this run": _shown(each, each.second),
            }
            for each in self.partings
        ]

    def text(self) -> str:
        """Return the contents of `parting.txt`."""
        lines = [self.line()]
        for row in self.rows():
            lines += ["", f"first {row['first']} that differs: {row['vehicle']}, at {row['time (s)']} s"]
            lines += [f"  {name}: {row[name]}" for name in ("in the run that passes", "in this run")]
        if self.until:
            lines += ["", f"{self.partings[0].node} until then, in this run:"]
            lines += [f"  {printable(line, LONGEST)}" for line in self.until]
        return "\n".join(lines) + "\n"

    def as_json(self) -> dict[str, Any]:
        """Return the explanation's part of campaign.json."""
        if self.why_not:
            return {"why_not": self.why_not}
        return {"passing": self.passing, "differences": self.rows()}


def _seconds(time_ns: int) -> str:
    return f"{time_ns / NS_PER_S:.6f}"


def _shown(parting: Parting, text: str) -> str:
    nothing = "FIFO order" if parting.kind == "decision" else "nothing"
    return printable(text.removeprefix(f"{parting.node}: "), LONGEST) or nothing


def explain(failing: Scenario, folder: Path, passed: Scenario | None, pool: TrialPool) -> Explanation:
    """Compare the run in `folder`, of the scenario `failing`, with the first candidate that passes.

    `passed` is another run of the campaign that has passed, if there is one. At most four runs are made, which
    leave nothing; none begins later than the pool's time limit after the first.
    """
    try:
        run = RecordedRun.open(folder)
        _ = run.trace
    except VnetError:
        return Explanation(why_not="the run did not come to its end, and has no trace")
    until_s = time.monotonic() + pool.limit_s
    tried = []
    for name, scenario in _candidates(failing, passed):
        if pool.closed or time.monotonic() > until_s:
            return Explanation(why_not="no time was left for it")
        tried.append(name)
        with tempfile.TemporaryDirectory(prefix="vnet-passing-") as place:
            trial = pool.run(scenario, Path(place) / "run")
            if trial.verdicts and not trial.failed:
                return _compared(name, RecordedRun.open(Path(place) / "run"), run)
    none = "no run of the campaign has passed" if passed is None else "none of these passes"
    return Explanation(why_not=f"{none}{': ' if tried else ''}{', '.join(tried)}{' fails too' if tried else ''}")


def _compared(name: str, passing: OpenedRun, failing: OpenedRun) -> Explanation:
    try:
        found = tuple(partings(passing, failing))
        told = before(failing.trace, failing.events, found[0].node, found[0].time_ns) if found else ()
    except VnetError as error:
        return Explanation(why_not=str(error))
    return Explanation(name, found, tuple(told))


def _candidates(failing: Scenario, passed: Scenario | None) -> Iterator[tuple[str, Scenario]]:
    """Yield the runs that may pass, the one most like the failing run first, each with its name."""
    if failing.run.order != "fifo" or failing.run.tape is not None:
        yield "the same run in FIFO order", with_tape(failing, ())
    if failing.fault:
        yield "the same run without faults", with_faults(failing, ())
    if passed is None:
        return
    seed = passed.run.seed
    with suppress(VnetError):  # its faults may name vehicles or links that this seed's network has not got
        like_it = with_seed(failing, seed)
        if dump_scenario(like_it) != dump_scenario(passed):
            yield f"the same run with seed {seed}", like_it
    yield f"the campaign's run with seed {seed}", passed


NO_FAULTS = "no faults"
"""Row of the runs without any fault."""
Matrix = Mapping[str, Mapping[str, Counter[Verdict]]]
_NUMBERS = re.compile(r"(\.py:\d+)|\b0x[0-9a-f]+\b|\d+(?:[.,]\d+)*|'[^']*'")
"""Parts of a text that differ from run to run: numbers, names of vehicles, and what is quoted; lines do not."""
ALPHA = 0.05
"""Probability of error, both of the bound of the rate and of as many green runs by chance."""
TEST_FILE = "test_failure_{}.py"
"""Name of a failure's test, by the name of its folder: pytest takes modules of one name for one."""
TEXT = '''"""Failure {number} of a campaign: {checks}. Written by vnet; `pytest {file}` runs it."""

from pathlib import Path

from emulator.testing.campaign import failures


def test_failure_{name}(tmp_path: Path) -> None:
    scenario = Path(__file__).with_name("scenario.toml")
    assert failures(scenario, tmp_path / "run", limit_s={limit_s:g}{twice}) == {{}}
'''
FAILURE_PAGE = "failure.html"
NS_PER_US = 1000
FORMAT = 1
WRITE_EVERY = 20
RESULT_ROOM_BYTES = 1 << 14
"""Size of most runs in campaign.json and campaign.html."""


def column_of(check: str) -> tuple[str, str | None]:
    """Return the column of a check; and for the check of a single fault the kind in whose row alone it stands."""
    match = re.fullmatch(r"(\w+):(\w+)-\d+", check)
    return (f"{match[1]} (its own)", match[2]) if match else (check, None)


def count_verdicts(runs: Iterable[tuple[Sequence[str], Mapping[str, Verdict]]]) -> Matrix:
    """Count the verdicts by kind of fault and check, of runs with the kinds of their faults and their verdicts."""
    matrix: dict[str, dict[str, Counter[Verdict]]] = {}
    for kinds, verdicts in runs:
        for kind in sorted(set(kinds)) or [NO_FAULTS]:
            row = matrix.setdefault(kind, {})
            for check, verdict in verdicts.items():
                column, only = column_of(check)
                if only in (None, kind):
                    row.setdefault(column, Counter())[verdict] += 1
    return dict(sorted(matrix.items()))


def page(
    title: str,
    facts: Sequence[str],
    matrix: Matrix,
    failures: Sequence[Mapping[str, Any]],
    failure_kinds: Sequence[object] = (),
) -> str:
    """Return the whole page.

    A failure has `number`, `seed`, `checks` (texts by name), `schedule` (TOML), `order` (a phrase), `command`,
    `folder` and `parting` (where it parts from a run that passes, or None); a kind of failures `check`, `text`,
    `first` (a number) and `runs`.
    """
    columns = list(dict.fromkeys(column for row in matrix.values() for column in row))
    kinds = {kind: [_cell(row.get(column, Counter())) for column in columns] for kind, row in matrix.items()}
    return render(
        "campaign.html.j2",
        title=title,
        facts=facts,
        columns=columns,
        kinds=kinds,
        failures=failures,
        failure_kinds=failure_kinds,
    )


def _cell(counts: Counter[Verdict]) -> tuple[Counter[Verdict], Verdict | None]:
    """A cell of the matrix: how often each verdict was given, and the worst of them."""
    return counts, next((verdict for verdict in WORST_FIRST if counts[verdict]), None)


@dataclass(frozen=True)
class FailureKind:
    """Runs in which a check failed in one way: their count, and number and text of the first."""

    check: str
    text: str
    first: str
    runs: int = 1


def failure_kinds(failures: Iterable[tuple[str, Mapping[str, str]]]) -> list[FailureKind]:
    """Return the kinds of failures, given by number with their texts by check; the most frequent come first."""
    kinds: dict[tuple[str, str], FailureKind] = {}
    for number, texts in failures:
        of_this_run: dict[tuple[str, str], FailureKind] = {}
        for check, text in texts.items():
            column = column_of(check)[0]
            of_this_run.setdefault(
                (column, _NUMBERS.sub(lambda part: part[1] or "#", text)), FailureKind(column, text, number)
            )
        for key, kind in of_this_run.items():
            before = kinds.get(key)
            kinds[key] = kind if before is None else replace(before, runs=before.runs + 1)
    return sorted(kinds.values(), key=lambda kind: -kind.runs)


def green_runs_needed(failed: int, runs: int, alpha: float = ALPHA) -> int:
    """Return how many runs in a row must pass, if `failed` (at least one) of so many have failed before."""
    return math.ceil(math.log(alpha) / math.log1p(-lowest_share(failed, runs, alpha)))


def failures_by_check(results: Sequence[Mapping[str, Any]]) -> Counter[str]:
    """Count the runs of `campaign.json` in which each check failed."""
    counts: Counter[str] = Counter()
    for row in results:
        counts.update({column_of(name)[0] for name, verdict in _checks(row) if verdict == Verdict.INVALID})
    return counts


def _checks(row: Mapping[str, Any]) -> list[tuple[str, Any]]:
    checks = row.get("checks")
    return list(checks.items()) if isinstance(checks, dict) else []


def _judging(results: Sequence[Mapping[str, Any]], check: str) -> list[Mapping[str, Any]]:
    """Return the runs of `campaign.json` in which a check was judged: all for those that only a failure has."""
    if check in (HUNG, EMULATOR, REFUSED):
        return list(results)
    judged = (Verdict.VALID, Verdict.INVALID)
    return [row for row in results if any(column_of(n)[0] == check and v in judged for n, v in _checks(row))]


def after_a_fix(results: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each check that failed: the runs that make its fix credible."""
    for check, failed in failures_by_check(results).most_common():
        runs = len(_judging(results, check))
        yield (
            f"{check} failed in {failed} of {runs} runs: once it is fixed, {green_runs_needed(failed, runs)} runs "
            f"without a failure make that credible ({1 - ALPHA:.0%})"
        )


def compared_with_before(before: Sequence[Mapping[str, Any]], now: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Yield a line for each check that failed before: whether it is credibly fixed now, by runs of other seeds."""
    failing = failures_by_check(now)
    seeds = [row.get("seed") for row in before]
    known = {seed for seed in seeds if isinstance(seed, int)}
    for check, failed in failures_by_check(before).most_common():
        runs, judging = len(_judging(before, check)), _judging(now, check)
        was = f"{check} failed in {failed} of {runs} runs before"
        new = [row for row in judging if row.get("seed") not in known]
        if failing[check]:
            yield f"{was}, and in {failing[check]} of {len(judging)} now"
        elif not judging:
            yield f"{was}, and was judged in no run now"
        elif not new:
            yield f"{was}, and in none of {len(judging)} now, the same runs: compare others (--seed with --before)"
        else:
            needed = green_runs_needed(failed, runs)
            told = f"{was}, and in none of {len(new)} now{' with other seeds' if len(new) < len(judging) else ''}"
            if len(new) >= needed:
                yield f"{told}: a fix is credible, for which {needed} runs are enough"
            else:
                yield f"{told}: a fix is credible from {needed} runs on ({1 - ALPHA:.0%})"


def regression_test(number: str, checks: Sequence[str], limit_s: float) -> str:
    """Return the test of the failure of this number, of these checks, whose run may take `limit_s` seconds."""
    name = "".join(character if character.isalnum() else "_" for character in number)
    twice = ", twice=True" if REPLAY in checks else ""
    return TEXT.format(
        number=number,
        name=name,
        checks=", ".join(checks),
        file=TEST_FILE.format(number),
        limit_s=limit_s,
        twice=twice,
    )


def failures(scenario: Path, folder: Path, limit_s: float, twice: bool = False) -> dict[str, str]:
    """Simulate a scenario as a campaign does, and return the texts of the checks that fail by their names.

    It runs in a process of its own, and its files stay in `folder`. One that takes more than `limit_s` seconds, or
    ends its process, has failed; `twice` has it made again in another way. Raises VnetError if it cannot be run.
    """
    loaded = load_scenario(scenario)
    pool = TrialPool(limit_s, loaded, twice=twice)
    try:
        trial = pool.run(loaded, folder)
    finally:
        pool.close()
    return {name: trial.texts[name] for name in trial.failed}


def write_failure_page(folder: Path, title: str, checks: Mapping[str, str], explanation: Explanation) -> Path:
    """Write the page of a failure whose run is in `folder`; `checks` has the texts of those that failed.

    Its timeline begins at the first failure of a program, else at the parting. Raises VnetError where the disk
    refuses.
    """
    source = Source(folder)
    first = explanation.partings[0].time_ns // NS_PER_US if explanation.partings else None
    page = render(
        "failure.html.j2",
        title=title,
        checks=checks,
        parting=shown_parting(explanation),
        timeline=maybe(lambda: timeline(source, at_us=first)),
    )
    return put_page(folder / FAILURE_PAGE, page)


def shown_parting(explanation: Explanation) -> dict[str, Any]:
    """Return the explanation as pages show it: its line, its table, and what came before."""
    rows = table(explanation.rows()) if explanation.partings else None
    node = explanation.partings[0].node if explanation.partings else ""
    return {"line": explanation.line(), "rows": rows, "node": node, "until": explanation.until}


@dataclass(frozen=True)
class CampaignRun:
    """A run that is over; of one that failed also the shrunk one, and the folder where it is kept."""

    number: int
    """Number of the run in its campaign, from 1."""
    scenario: Scenario
    trial: Trial
    shrunk: Scenario | None = None
    again: Trial | None = None
    steps: int = 0
    folder: Path | None = None
    explanation: Explanation | None = None
    """Comparison of the shrunk run with one that passes; None before it is made."""

    @property
    def passed(self) -> bool:
        """True if the run was judged, and nothing failed."""
        return bool(self.trial.verdicts) and not self.trial.failed

    @property
    def seed(self) -> int:
        """Seed of the run."""
        return self.scenario.run.seed

    @property
    def label(self) -> str:
        """Name of its folder, should it have failed."""
        return f"{self.number:03d}"

    @property
    def kinds(self) -> list[str]:
        """The kinds of its faults."""
        return [fault.kind for fault in self.scenario.fault]

    def schedule(self) -> str:
        """The smallest schedule found that still fails, as TOML."""
        return schedule_toml((self.shrunk or self.scenario).fault)

    def order(self) -> str:
        """The order of events of the smallest case, as a phrase; "" if it is FIFO."""
        run = (self.shrunk or self.scenario).run
        if run.order != "fifo":
            return f"{run.order}, seed {run.order_seed}"
        return "" if run.tape is None or isinstance(run.tape, Path) else order_text(run.tape)

    def texts(self) -> dict[str, str]:
        """Return the texts of the failed checks, of the shrunk run if they failed there."""
        trial = self.again if self.again is not None and self.again.failed else self.trial
        texts = {name: trial.texts[name] for name in trial.failed}
        told = {column_of(name) for name in texts}
        texts |= {name: self.trial.texts[name] for name in self.trial.failed if column_of(name) not in told}
        if self.again is not None and self.again.verdicts and not self.again.failed:
            texts["replay"] = "it failed, and did not when it was run again"
        return texts

    def told(self) -> dict[str, str]:
        """Return `texts` for those who look into the folder, with a note on the checks that did not fail there."""
        kept = {column_of(name) for name in (self.again.failed if self.again is not None else ())}
        note = "not when it was run again" if self.shrunk == self.scenario else "not in the shrunk run"
        return {
            name: f"{text}; {note}" if kept and column_of(name) not in kept else text
            for name, text in self.texts().items()
        }

    def as_json(self) -> dict[str, Any]:
        """The run's part of campaign.json."""
        row: dict[str, Any] = {
            "seed": self.seed,
            "faults": [fault.model_dump(mode="json", exclude_none=True) for fault in self.scenario.fault],
            "checks": {name: verdict.value for name, verdict in self.trial.verdicts.items()},
            "trace_sha256": self.trial.trace_sha256,
            "wall_s": round(self.trial.wall_s, 2),
        }
        if self.folder is not None:
            row |= {
                "failed": self.told(),
                "shrunk": self.schedule(),
                "order": self.order(),
                "steps": self.steps,
                "folder": str(self.folder),
            }
        if self.explanation is not None:
            row["parting"] = self.explanation.as_json()
        return row


def schedule_toml(schedule: Schedule) -> str:
    """A schedule as it stands in a scenario."""
    tables = []
    for fault in schedule:
        data = {"kind": fault.kind} | fault.model_dump(mode="json", exclude_none=True)
        tables.append("\n".join(["[[fault]]", *_lines(data)]))
    return "\n\n".join(tables)


def _lines(table: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """TOML with dotted keys, which is shorter than what tomli_w writes."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _lines(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key} = {json.dumps(value)}"


class Campaign:
    """A campaign as it runs, in a new folder of its own."""

    def __init__(self, plan: Plan, folder: Path, progress: Progress, executor: Executor | None = None) -> None:
        self._plan = plan
        self._folder = folder
        self._progress = progress
        self._workshop = TrialPool(plan.limit_s, plan.scenario, executor, plan.check_determinism)
        self.outcomes: list[CampaignRun] = []
        self.interrupted = False
        self.unkept: list[str] = []
        """A line for each time that the disk has refused something."""

    @property
    def failures(self) -> list[CampaignRun]:
        """The runs that have failed, by number."""
        return sorted((o for o in self.outcomes if o.trial.failed), key=lambda o: o.number)

    @property
    def kinds(self) -> list[FailureKind]:
        """The ways in which runs have failed, the most frequent first."""
        return failure_kinds((outcome.label, outcome.texts()) for outcome in self.failures)

    @property
    def unjudged(self) -> list[FailureKind]:
        """The ways in which runs have not failed but stay unknown, or checks of the user's own do in all runs."""
        runs = sorted(self.outcomes, key=lambda o: o.number)
        judged = {n for o in runs for n, verdict in o.trial.verdicts.items() if verdict is not Verdict.UNKNOWN}

        def is_unjudged(name: str, trial: Trial) -> bool:
            return (name == "progress" and not trial.failed) or (name.startswith(PREFIX) and name not in judged)

        texts = ({n: t for n, t in o.trial.texts.items() if is_unjudged(n, o.trial)} for o in runs)
        return failure_kinds(zip((o.label for o in runs), texts, strict=True))

    def run(self) -> None:
        """All runs, so many at once as are planned; returns early, with what is there, after Ctrl-C."""
        self._task = self._progress.add_task("campaign", total=self._plan.runs)
        room = room_held(self._folder, self._plan.runs * RESULT_ROOM_BYTES)
        with room, ThreadPoolExecutor(self._plan.jobs) as pool:
            futures = [pool.submit(self._one, number) for number in range(self._plan.runs)]
            try:
                for future in as_completed(futures):
                    self._take(future.result())
                self.outcomes = list(pool.map(self._explained, self.outcomes))
            except KeyboardInterrupt:
                self.interrupted = True
                self._workshop.close()
                pool.shutdown(cancel_futures=True)
        self._workshop.close()
        self._take_left(futures)
        with self._noting():
            self.write()

    @contextmanager
    def _noting(self) -> Iterator[None]:
        """End the block where the disk refuses something, and note that in `unkept`."""
        try:
            yield
        except DiskError as error:
            self.unkept.append(str(error))

    def _run(self, scenario: Scenario, apart: bool = False) -> Trial:
        """Return a trial that leaves no files; nothing is known of one that the disk has refused."""
        with self._noting():
            return self._workshop.run_anywhere(scenario, apart)
        return UNKNOWN

    def _take(self, outcome: CampaignRun) -> None:
        if not outcome.trial.verdicts:  # it was given up, or the disk has refused it
            return
        self.outcomes.append(outcome)
        self._progress.update(
            self._task, advance=1, description=f"campaign: {counted(len(self.failures), 'failure')}"
        )
        if outcome.trial.failed or len(self.outcomes) % WRITE_EVERY == 0:
            with suppress(DiskError):  # it is written again at the end
                self.write()

    def _take_left(self, futures: Sequence[Future[CampaignRun]]) -> None:
        """Take the runs that were over, or half shrunk, when the campaign was interrupted."""
        taken = {outcome.number for outcome in self.outcomes}
        for future in futures:
            if future.cancelled() or future.exception() is not None:
                continue
            outcome = future.result()
            if outcome.number not in taken:
                self._take(outcome)

    def _one(self, number: int) -> CampaignRun:
        scenario = self._plan.draw(number)
        trial = self._run(scenario)
        outcome = CampaignRun(number + 1, scenario, trial)
        return self._shrink(outcome) if trial.failed else outcome

    def _shrink(self, outcome: CampaignRun) -> CampaignRun:
        """Shrink a failure, and run the smallest once more where it is kept."""
        wanted = {column_of(name) for name in outcome.trial.failed}
        until_s, apart = time.monotonic() + self._plan.limit_s, outcome.trial.apart

        def still_fails(smaller: Scenario) -> bool:
            if self._workshop.closed or time.monotonic() > until_s:
                return False
            return bool(wanted & {column_of(name) for name in self._run(smaller, apart).failed})

        shrunk, steps = self._smallest(outcome, still_fails) if self._plan.shrink_steps else (outcome.scenario, 0)
        folder = self._folder / "failures" / outcome.label
        outcome = replace(outcome, shrunk=shrunk, steps=steps, folder=folder)
        with self._noting(), disk_errors(folder):
            outcome = replace(outcome, again=self._workshop.run(shrunk, folder, apart))
            folder.mkdir(parents=True, exist_ok=True)
            if not (folder / SCENARIO_FILE).exists():  # its process has died before
                write_atomically(folder / SCENARIO_FILE, dump_scenario(shrunk))
            write_atomically(folder / "drawn.toml", schedule_toml(outcome.scenario.fault) + "\n")
            test = regression_test(folder.name, sorted(outcome.trial.failed), self._plan.limit_s)
            write_atomically(folder / TEST_FILE.format(folder.name), test)
        return outcome

    def _explained(self, outcome: CampaignRun) -> CampaignRun:
        """Return a run that has failed with what tells it from one that passes, which is also put in its folder."""
        folder, shrunk = outcome.folder, outcome.shrunk
        if folder is None or shrunk is None or outcome.again is None or self._workshop.closed:
            return outcome
        passed = [other for other in self.outcomes if other.passed]
        nearest = min(passed, key=lambda other: _distance(outcome, other), default=None)
        other = nearest.scenario if nearest else None
        title = f"Failure {outcome.label} of campaign {self._plan.scenario.run.name}"
        with self._noting(), disk_errors(folder):
            explanation = explain(shrunk, folder, other, self._workshop)
            outcome = replace(outcome, explanation=explanation)
            write_atomically(folder / PARTING_FILE, explanation.text())
            write_failure_page(folder, title, outcome.told(), explanation)
        return outcome

    def _smallest(self, outcome: CampaignRun, still_fails: Callable[[Scenario], bool]) -> tuple[Scenario, int]:
        """Return the least run found that still fails, and how many were tried: order, faults, vehicles, time."""
        base, left = outcome.scenario, self._plan.shrink_steps
        if base.run.order != "fifo":
            base, steps = shrink_order(base, outcome.trial.tape, still_fails, min(MOST_ORDER_STEPS, left))
            left -= steps
        schedule, steps = shrink(
            base.fault, lambda schedule: still_fails(with_faults(base, schedule)), min(MOST_STEPS, left)
        )
        left -= steps
        shrunk, steps = shrink_run(with_faults(base, schedule), still_fails, left)
        return shrunk, self._plan.shrink_steps - (left - steps)

    @property
    def rows(self) -> list[dict[str, Any]]:
        """The runs so far, as in campaign.json."""
        return [outcome.as_json() for outcome in sorted(self.outcomes, key=lambda o: o.number)]

    def write(self) -> None:
        """Write campaign.json and campaign.html of the runs so far."""
        head = {"format": FORMAT, "seed": self._plan.seed, "runs": self._plan.runs, "kinds": self._plan.kinds}
        head["drawn_from"] = self._plan.drawn_from
        if self._plan.ranges:
            head["ranges"] = {k: {n: r.bounds for n, r in of.items()} for k, of in self._plan.ranges.items()}
        write_atomically(self._folder / CAMPAIGN_FILE, json.dumps(head | {"results": self.rows}, indent=1) + "\n")
        write_atomically(self._folder / CAMPAIGN_PAGE, self._page())

    def _page(self) -> str:
        run = self._plan.scenario.run
        facts = [
            f"{len(self.outcomes)} of {self._plan.runs} runs of {run.duration_s:g} emulated seconds, "
            f"seeds from {self._plan.seed} on; {len(self.failures)} failed.",
            *([self._plan.note + "."] if self._plan.note else []),
            *(f"{one.check} was unknown in {counted(one.runs, 'run')}: {one.text}" for one in self.unjudged),
        ]
        matrix = count_verdicts((outcome.kinds, outcome.trial.verdicts) for outcome in self.outcomes)
        failures = [self._described(outcome) for outcome in self.failures]
        return page(f"Campaign {run.name}", facts, matrix, failures, self.kinds)

    def _described(self, outcome: CampaignRun) -> dict[str, Any]:
        assert outcome.folder is not None
        return {
            "number": outcome.label,
            "seed": outcome.seed,
            "checks": outcome.told(),
            "schedule": outcome.schedule(),
            "order": outcome.order(),
            "command": _reproduction(outcome.folder.absolute(), outcome.trial.failed),
            "folder": f"failures/{outcome.folder.name}",
            "parting": shown_parting(outcome.explanation) if outcome.explanation else None,
        }

    def summary(self) -> Iterator[Table | Text]:
        """Yield the failures for a terminal: a line a kind, and the first run of each kind in full."""
        kinds = self.kinds
        if len(kinds) < len(self.failures):
            for kind in kinds:
                yield Text(f"{counted(kind.runs, 'run')}, first {kind.first}: {kind.check}: {kind.text}")
        first = {kind.first for kind in kinds}
        table = Table(title=f"failures: {len(self.failures)} of {len(self.outcomes)} runs", title_justify="left")
        for name in ("", "seed", "failed", "smallest schedule"):
            table.add_column(name, overflow="fold")
        for outcome in (outcome for outcome in self.failures if outcome.label in first):
            told = self._described(outcome)
            texts = "\n".join(f"{name}: {text}" for name, text in told["checks"].items())
            least = "\n".join(filter(None, [told["schedule"] or "no faults", told["order"]]))
            table.add_row(told["number"], str(outcome.seed), Text(texts), Text(least))
        yield table
        for outcome in self.failures:
            if outcome.label in first and outcome.explanation is not None:
                yield Text(f"{outcome.label} {outcome.explanation.line()}")


def _reproduction(folder: Path, failed: Sequence[str]) -> str:
    """Return the command that shows a failure again: the test if it is of growth, for which nothing else looks."""
    if GROWTH in failed:
        return f"pytest {shlex.quote(str(folder / TEST_FILE.format(folder.name)))}"
    command = f"vnet simulate {shlex.quote(str(folder / SCENARIO_FILE))}"
    return f"{command} --check-determinism" if REPLAY in failed else command


def _distance(outcome: CampaignRun, other: CampaignRun) -> tuple[bool, int]:
    """Return by what to choose among runs to compare a run with: the last one before it, else the next."""
    return other.number > outcome.number, abs(other.number - outcome.number)


def _folders(name: str) -> Iterator[Path]:
    for number in count(1):
        yield RUNS / (name if number == 1 else f"{name}-{number}")


def _earlier(plan: Plan, name: str, before: Path | None, out: Path | None) -> list[dict[str, Any]]:
    """Return the runs of the earlier campaign that this one is compared with; none if there is none.

    Raises VnetError for a named folder that has none, or one whose runs were drawn from something else.
    """
    if before is not None:
        found = read_campaign(before)
        if found.drawn_from not in ("", plan.drawn_from):
            kinds = ", ".join(found.kinds) or "none"
            raise VnetError(
                f"--before {before}: its runs are not comparable: another scenario, or other faults ({kinds}) or "
                "ranges; a fix is credible by runs like those that failed"
            )
        return found.results
    if out is None:
        there = list(takewhile(Path.exists, _folders(name)))
        with suppress(VnetError):  # of another version, or edited
            if there and (last := read_campaign(there[-1])).drawn_from in ("", plan.drawn_from):
                return last.results
    return []


@contextmanager
def _interrupted_once() -> Iterator[None]:
    """Ctrl-C and SIGTERM interrupt the block once: a second one must not lose what there is."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        for each in handlers:
            signal.signal(each, signal.SIG_IGN)
        raise KeyboardInterrupt

    handlers = {each: signal.signal(each, interrupt) for each in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)


def run_campaign(
    plan: Plan, out: Path | None, console: Console, executor: Executor | None = None, before: Path | None = None
) -> int:
    """Run a campaign, print its result and return the exit status. Raises VnetError.

    Its runs are simulated on `executor`, by default on this machine; those that are kept always are. `before` is
    the folder of an earlier campaign, by default the last one of the same name: its failures may have been fixed.
    What the disk refuses is left out, and named by a VnetError at the end.

    0 if no run failed, 1 if one did, 3 if none did but some are `unjudged`, 130 if it was interrupted.
    """
    name = f"campaign-{plan.scenario.run.name}-{plan.seed}"
    folder = out or next(path for path in _folders(name) if not path.exists())
    earlier = _earlier(plan, name, before, out)
    check_is_free(folder, "--out ")
    with disk_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with _interrupted_once(), Progress(*columns, console=console) as progress:
        campaign = Campaign(plan, folder, progress, executor)
        campaign.run()
    if campaign.failures:
        console.print(*campaign.summary(), sep="\n")
    for kind in campaign.unjudged:
        console.print(Text(f"unknown in {counted(kind.runs, 'run')}: {kind.check}: {kind.text}"))
    for line in (*compared_with_before(earlier, campaign.rows), *after_a_fix(campaign.rows)):
        console.print(Text(line))
    failed = f"{counted(len(campaign.outcomes), 'run')}, {len(campaign.failures)} failed"
    console.print(f"{failed}: {folder / CAMPAIGN_PAGE}", highlight=False, soft_wrap=True)
    if campaign.unkept:
        more = len(campaign.unkept) - 1
        raise VnetError(campaign.unkept[0] + (f", and {more} more" if more else ""))
    if folder.resolve().parent.name == RUNS.name:
        write_index(folder.resolve().parent)
    if campaign.interrupted:
        return 130
    if campaign.failures:
        return Verdict.INVALID.exit_status
    return Verdict.UNKNOWN.exit_status if campaign.unjudged else 0
