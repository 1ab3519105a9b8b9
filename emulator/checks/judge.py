"""The verdict on a run, from its trace, states, metrics and events alone, and the table of all checks.

Each check is *valid*, *invalid* or *unknown*, with its figures and the offending rows. A check that the scenario
could not exercise (a cap that no neighbourhood exceeds) is not applicable and listed with its reason; one that
should have seen something and saw nothing is unknown.

Each check is of one of two classes, its `subject`. A check of the run judges trace, states and events, and may be
invalid. A check of the machine (memory, wall clock, processor, disk) is never invalid: it adds a note, or is
unknown where the run cannot be trusted. A machine that is slow or small does not make a right run wrong.

A check is added by one entry of `CHECKS` and its function. `judge` runs the table in its order,
docs/reference/checks.md is generated from it, and the page of a campaign has a column for whatever was judged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path

from emulator.checks.channel import (
    check_conservation,
    check_isolation,
    check_latency,
    check_loss_rate,
    check_peer_cap,
    check_range,
)
from emulator.checks.faults import (
    check_causes,
    check_copies,
    check_down_respected,
    check_fault_effects,
    check_fault_loss,
    check_gnss,
    check_outage_respected,
    check_partition_respected,
    check_pause_respected,
)
from emulator.checks.folder import judge_folder
from emulator.checks.own import PREFIX, check_own_rules, load_checks, own_findings, recorded_findings
from emulator.checks.radio import check_fading, check_medium
from emulator.checks.replay import ONCE, check_replay
from emulator.checks.run import (
    FLOOR_KIB,
    RISING_TENTHS,
    check_agents_alive,
    check_fault_events,
    check_finite,
    check_kept_up,
    check_liveness,
    check_memory,
    check_no_exceptions,
    check_presence,
    check_progress,
    check_reports,
    check_row_order,
    check_transport,
)
from emulator.radio.trace import sha256_of_table
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.run import Run
from emulator.records.verdicts import CheckResult, Finding, Judgement, NotExercised, Verdict, named
from emulator.scenario.loading import with_modules
from vnet.reports import LONGEST_TEXT

Function = Callable[[RecordedRun], Finding] | Callable[[RecordedRun], Iterator[Finding]]

NO_PERIOD = "no period was completed, so the positions are not known"
NOBODY_IN_RANGE = "no vehicle has another in range"
__all__ = [
    "CheckResult",
    "Judgement",
    "NotExercised",
    "RecordedRun",
    "Verdict",
    "check_run",
    "judge",
]


class WithoutPositions(Enum):
    """The treatment of a check in a run that ended within its first period, so that no position is known."""

    JUDGE = "judge"
    UNKNOWN = "unknown"
    NOT_APPLICABLE = "not applicable"


class Subject(Enum):
    """The class of a check: the subject of its verdict."""

    RUN = "of the run"
    MACHINE = "of the machine"


@dataclass(frozen=True)
class Check:
    """One check: its function and its row of the reference page.

    `invalid`, `unknown` and `not_applicable` say when a run gets that verdict; empty: never. `name` defaults to
    that of the function; a check with a finding for each fault is named `NAME:LABEL`, and its function yields them
    with their names.
    """

    function: Function
    chapter: str
    claims: str
    invalid: str = ""
    unknown: str = ""
    not_applicable: str = ""
    name: str = ""
    without_positions: WithoutPositions = WithoutPositions.NOT_APPLICABLE
    realtime_sensitive: bool = False
    """True if a machine that did not keep up can make it invalid; the verdict is then unknown."""
    subject: Subject = Subject.RUN
    """The class of the check; one of the machine cannot be invalid."""

    def __post_init__(self) -> None:
        assert self.subject is Subject.RUN or not self.invalid, "a check of the machine is never invalid"
        if not self.name:
            object.__setattr__(self, "name", self.function.__name__.removeprefix("check_"))

    @property
    def per_fault(self) -> bool:
        """True if there is a finding for each fault."""
        return self.name.endswith(":LABEL")

    def findings(self, recorded: RecordedRun) -> Iterator[Finding]:
        """Judge a run."""
        if len(recorded.states) or self.without_positions is WithoutPositions.JUDGE:
            found = self.function(recorded)
            findings = found if isinstance(found, Iterable) else [named(self.name, found)]
            yield from map(self._within_class, findings)
        elif self.without_positions is WithoutPositions.UNKNOWN:
            yield CheckResult(self.name, Verdict.UNKNOWN, NO_PERIOD)
        elif not self.per_fault:
            yield NotExercised(self.name, NO_PERIOD)

    def _within_class(self, finding: Finding) -> Finding:
        """Return a finding as the class of the check allows it: what would be invalid of the machine is unknown."""
        if self.subject is Subject.RUN or isinstance(finding, NotExercised):
            return finding
        return replace(finding, verdict=Verdict.UNKNOWN) if finding.verdict is Verdict.INVALID else finding


RADIO, FAULTS, REPORTS, RUN = "The radio", "Faults", "What vehicles report", "The run"
MACHINE = "The machine"
ONE_IN_A_MILLION = "outside a band that sound runs leave once in a million"
BEHIND = "the machine did not keep up"

CHECKS: list[Check] = [
    Check(
        check_conservation,
        RADIO,
        "Each frame has one row, with one outcome, for each receiver in range; so has each copy that a fault "
        "sends. What is received twice names its original, sequence numbers have no gaps, and receptions that "
        "arrived, and no others, have an arrival time after their sending time.",
        invalid="a row too many, too few or out of order",
        unknown="no frame was sent",
        not_applicable=NOBODY_IN_RANGE,
        without_positions=WithoutPositions.UNKNOWN,
    ),
    Check(
        check_range,
        RADIO,
        "Nothing was delivered beyond the range, against the link matrix, or below the mean power `floor_dbm`.",
        invalid="a delivery beyond the range",
        unknown="nothing was delivered",
        not_applicable=NOBODY_IN_RANGE,
        without_positions=WithoutPositions.UNKNOWN,
    ),
    Check(
        check_peer_cap,
        RADIO,
        "Each receiver hears its nearest `max_peers` senders that are up. Frames sent at the instant of a "
        "death are not judged.",
        invalid="a reception on the wrong side of the cap, or beyond a cap that nothing exceeds",
        unknown="the cap could have acted and never did",
        not_applicable="no receiver has so many senders in range",
        without_positions=WithoutPositions.UNKNOWN,
    ),
    Check(
        check_loss_rate,
        RADIO,
        "Of the receptions that no fault decided and that could be decoded, the share `radio.loss` is lost; with "
        "links over time that of their losses.",
        invalid="outside the binomial 99.9999 % band, or lost on a link that loses nothing",
        unknown="no reception came so far",
        not_applicable=NOBODY_IN_RANGE,
        without_positions=WithoutPositions.UNKNOWN,
    ),
    Check(
        check_fading,
        RADIO,
        "As many receptions faded as path loss, shadowing, fading and receiver predict, in all and on each "
        "link; without fading, exactly those that must.",
        invalid=f"the total or the links' χ² {ONE_IN_A_MILLION}; or an impossible reception",
        unknown="no reception came so far",
        not_applicable="unit-disc radio: no fading; on a sidelink frames that are sent twice, or of senders whose "
        "frames need different numbers of subchannels",
    ),
    Check(
        check_medium,
        RADIO,
        "No vehicle starts to send while it has sensed others for longer than 4 µs, without the interframe "
        "space of its access category, or earlier than congestion control lets it; none receives while it "
        "sends; each collision met another transmission; time on air equals the airtime; no channel busy ratio "
        "is less than the vehicle's own transmissions.",
        invalid="one of these",
        unknown="no frame was sent",
        not_applicable="no MAC configured",
    ),
    Check(
        check_latency,
        RADIO,
        "No reception arrives earlier than airtime, latency and delaying faults allow, or later than the "
        "sender's queue, the jitters, the tick and faults explain; the queue may have held frames that nobody was "
        "in range of. Where nothing queues, the mean is as expected. On a shared medium these times count from the "
        "start of the transmission.",
        invalid="an arrival out of bounds, or a mean beyond 4.9 σ",
        unknown="nothing arrived",
        not_applicable=NOBODY_IN_RANGE,
    ),
    Check(
        check_isolation,
        RADIO,
        "What arrives is what was sent, byte for byte, unless a fault changed it. A program that reports "
        "`heard` (packets since its last report) never claims more than had arrived. Refused messages are "
        "counted.",
        invalid="other bytes, or a claim of more",
        unknown="nothing arrived",
        not_applicable=NOBODY_IN_RANGE,
    ),
    Check(
        check_causes,
        FAULTS,
        "A row names a fault exactly where one of a fitting kind acted, on that link and at that time.",
        invalid="a row that no fault explains",
        not_applicable="no faults",
    ),
    Check(
        check_partition_respected,
        FAULTS,
        "Nothing sent across a cut (partition, block, range, swizzle) passes it.",
        invalid="a reception that passed",
        unknown="no frame was sent across a cut",
        not_applicable="no such fault",
    ),
    Check(
        check_down_respected,
        FAULTS,
        "A vehicle that is down (killed, restarted, not in the network, or ended by itself) sends and reports "
        "nothing, and what arrives there is `receiver_down`; a vehicle that is up receives.",
        invalid="a frame, report or arrival that contradicts it",
        unknown=BEHIND,
        not_applicable="no vehicle was down",
        realtime_sensitive=True,
    ),
    Check(
        check_pause_respected,
        FAULTS,
        "A paused vehicle sends and reports nothing. In real time a pause that is to begin within a restart of the "
        "emulator, or of a router that is not a vehicle's own, begins after it.",
        invalid="a frame or a report",
        unknown=BEHIND,
        not_applicable="no vehicle was paused",
        realtime_sensitive=True,
    ),
    Check(
        check_fault_events,
        FAULTS,
        "Events tell the start and the end of each fault, with its nodes, and each restart, at the instants of the "
        "plan; in real time at any instant, and restarts are not judged.",
        invalid="an event too many, missing, or at another instant",
        not_applicable="no faults",
    ),
    Check(
        check_outage_respected,
        FAULTS,
        "A receiver has no fix exactly while an outage acts on it.",
        invalid="a fix given or withheld wrongly",
        not_applicable="no outage",
    ),
    Check(
        check_copies,
        FAULTS,
        "`DoS` and `Sybil` send each frame as often as configured; `DataReplay` sends the last old enough one.",
        invalid="a frame sent too often, too seldom, or at another time",
        not_applicable="no such fault",
    ),
    Check(
        check_own_rules,
        FAULTS,
        "Rules of your own (`custom`, `custom_sender`) answered each frame, sensors and figures of your own each "
        "period. What fails is named with error and line: it lets everything pass, or is unknown, from then on.",
        invalid="a rule, a sensor or a figure raised, did not answer, or answered nonsense",
        not_applicable="no rule and no sensor of your own",
        without_positions=WithoutPositions.JUDGE,
    ),
    Check(
        check_gnss,
        FAULTS,
        "Fixes differ from the truth, the errors of `[world]` and the offsets of faults by zero-mean noise of "
        "`world.gnss.sigma_m`. Frozen and random fixes are not judged.",
        invalid=f"{ONE_IN_A_MILLION}, over all fixes without faults or those under one fault",
        unknown="no such fix",
    ),
    Check(
        check_presence,
        REPORTS,
        "Each vehicle enters and leaves (events `entered`, `left`) when its trip does. One that a fault has "
        "taken enters when the fault ends, and in real time when its process has started.",
        invalid="an event too many, missing, or at another time",
        not_applicable="no vehicle moves, or all are there throughout",
    ),
    Check(
        check_liveness,
        REPORTS,
        "Once no fault acts any more, and restarts are over, each vehicle that is up reports at least once a "
        "second or every two periods. A program that usually reports less often has twice its usual time, at most "
        "two seconds or four periods. A process that starts in real time has 5 s; without faults, so has every "
        "program at first and after it enters. A program that never reported is not expected to.",
        invalid="a longer silence",
        unknown="a fault took a vehicle that never reported, or its fixes, before it had as long as others took "
        f"for their first report, and a second; {BEHIND}",
        not_applicable="no program reports so often, or less than a second is left",
        realtime_sensitive=True,
    ),
    Check(
        check_fault_loss,
        FAULTS,
        "A `loss` loses its share of the receptions that came so far; a `burst_loss` that of a two-state chain "
        "that starts good, with a band that allows for the correlation within bursts.",
        invalid=ONE_IN_A_MILLION,
        unknown="no reception came so far",
        name="loss_rate:LABEL",
    ),
    Check(
        check_fault_effects,
        FAULTS,
        "The fault took effect.",
        unknown="nothing shows that it did, or the run ended before it began",
        not_applicable="nothing could show it, it was healed before it began, or lasts less than a nanosecond",
        name="effect:LABEL",
    ),
    Check(
        check_transport,
        MACHINE,
        "No message between agents and emulator went missing, but for those sent during a restart of emulator or "
        "router.",
        unknown="a gap in sequence numbers, or a delivery that never arrived",
        without_positions=WithoutPositions.JUDGE,
        subject=Subject.MACHINE,
    ),
    Check(
        check_agents_alive,
        RUN,
        "No process died and no program crashed, except those that a fault ended.",
        invalid="one did",
        unknown="no event says that the run started; or in real time a vehicle has not come up",
        without_positions=WithoutPositions.JUDGE,
    ),
    Check(
        check_no_exceptions,
        RUN,
        "Programs handled every exception that was raised in their tasks, callbacks, `finally` blocks, executor "
        "jobs, threads and `__del__`. One that is awaited, however late, is handled; one that leaves `main` counts "
        "in `agents_alive`.",
        invalid="an event `exception`",
        unknown="no event says that the run started",
        without_positions=WithoutPositions.JUDGE,
    ),
    Check(
        check_progress,
        RUN,
        "The run reached its end.",
        invalid="a program does not let time advance (busy loop)",
        unknown="the run hung, was interrupted, or lacks periods",
        without_positions=WithoutPositions.JUDGE,
    ),
    Check(
        check_finite,
        RUN,
        "No report holds NaN or infinity.",
        invalid="one does",
        not_applicable="no program reports",
        without_positions=WithoutPositions.JUDGE,
    ),
    Check(
        check_reports,
        RUN,
        "Reports hold what `node.report` allows: covariance matrices that are symmetric and positive semidefinite, "
        "names that are identifiers, with a dot and any printable text behind it, and texts of at most "
        f"{LONGEST_TEXT} characters.",
        invalid="one holds something else",
        not_applicable="no program reports",
    ),
    Check(
        check_row_order,
        RUN,
        "The rows of trace, states and metrics are in their order, and those of each period have its time.",
        invalid="a row out of order",
    ),
    Check(
        check_memory,
        MACHINE,
        "The private memory of agents' processes, in events `memory` {node, time_s, private_kb}. A note names "
        f"those in which it grows steadily: it rises in at least {RISING_TENTHS} of the ten tenths of the second "
        f"half of a process's life, and by at least {FLOOR_KIB:g} KiB in all without a step or two. The emulator's "
        "own process keeps the trace and is not judged.",
        unknown="a process exceeded `run.memory_limit_mb`, which ended the run",
        not_applicable="no process of a program was measured, as by vnet simulate, or for less than 30 s",
        without_positions=WithoutPositions.JUDGE,
        subject=Subject.MACHINE,
    ),
    Check(
        check_kept_up,
        MACHINE,
        "In real time, at most 0.1 % of deliveries are over 20 ms late, or early, by the clock of their process "
        "(early where the clock of a host drifts or was stopped): the lower end of the 95 % confidence interval of "
        "their share (Clopper and Pearson) is not above it. Of what a restart of emulator or router holds back "
        "only the time after that counts.",
        unknown="more are, or none was timed",
        not_applicable="lockstep: nothing can be late",
        without_positions=WithoutPositions.JUDGE,
        subject=Subject.MACHINE,
    ),
]
"""All checks that a recorded run is judged by, in the order of a verdict."""


def judge(recorded: RecordedRun, own: Iterable[Finding] = ()) -> Judgement:
    """Judge a run by all checks; `own` are the findings of checks of the user's own."""
    findings: list[Finding] = [finding for check in CHECKS for finding in check.findings(recorded)]
    findings += [ONCE, *own]
    checks = [finding for finding in findings if isinstance(finding, CheckResult)]
    skipped = [finding for finding in findings if isinstance(finding, NotExercised)]
    return Judgement(_downgrade_if_overloaded(checks), skipped, sha256_of_table(recorded.trace))


def _downgrade_if_overloaded(checks: list[CheckResult]) -> list[CheckResult]:
    """Make invalid checks of timing unknown if the machine did not keep up."""
    of_machine = {check.name for check in CHECKS if check.subject is Subject.MACHINE}
    sensitive = {check.name for check in CHECKS if check.realtime_sensitive}
    if all(check.verdict is Verdict.VALID for check in checks if check.name in of_machine):
        return checks
    return [
        replace(check, verdict=Verdict.UNKNOWN, text=f"{check.text}; but the machine did not keep up")
        if (check.name in sensitive or check.name.startswith(PREFIX)) and check.verdict is Verdict.INVALID
        else check
        for check in checks
    ]


def check_run(folder: Path, own_checks: bool = False, checks: Sequence[str] = ()) -> Judgement:
    """Judge a run from its folder. Raises VnetError if the folder is not a finished run's.

    Checks of the user's own stand as the folder holds them; nothing that it names is imported. With `own_checks`
    those of its scenario are run again, and so are further `checks`. A trace that is not the one whose hash the
    verdict holds makes the run invalid.
    """
    recorded = RecordedRun.open(folder)
    trace_sha256 = recorded.record.trace_sha256
    judgement = judge(recorded, _own_findings(recorded, folder, own_checks, checks))
    judgement.put(check_replay(folder))
    if judgement.trace_sha256 != trace_sha256:
        text = f"the trace is not the one that verdict.json speaks of ({trace_sha256[:12]}…)"
        judgement.put(CheckResult("trace_sha256", Verdict.INVALID, text))
    judge_folder(recorded, judgement)
    return judgement


def _own_findings(recorded: OpenedRun, folder: Path, own_checks: bool, checks: Sequence[str]) -> list[Finding]:
    """Findings of checks of the user's own: as recorded, or of those that are run again."""
    program, found = recorded.scenario.program, {}
    exceptions = tuple(each.model_copy(update={"command": None}) for each in program.exceptions)
    program = program.model_copy(update={"command": None, "exceptions": exceptions})  # whose files may be gone
    if not own_checks:  # the folder has no say in where modules come from
        program = program.model_copy(update={"checks": (), "folders": ()})
        found = {finding.name: finding for finding in recorded_findings(recorded.record)}
    program, _ = with_modules(program, (), None, checks)
    load_checks(program)
    return list(
        (found | {finding.name: finding for finding in own_findings(program, Run(recorded, folder))}).values()
    )
