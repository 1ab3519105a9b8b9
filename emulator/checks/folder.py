"""Checks of a finished run's folder, which `vnet check` makes beside those of the run: its files fit together.

A folder of an earlier format has no manifest, and was written without these checks: where one of them finds
something there, the run is *unknown* and not *invalid*.
"""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from emulator.checks.channel import received_twice
from emulator.checks.own import PREFIX
from emulator.checks.recomputed import check_metrics, check_outcomes, checked_world
from emulator.records.code_digest import vnet_digest
from emulator.records.costs import Costs, PayloadSizes, RunCost, run_cost
from emulator.records.driven_table import driving_figures
from emulator.records.events import EventKind
from emulator.records.manifest import differing_files, read_manifest
from emulator.records.metrics import rows_of, summarize
from emulator.records.radio_metrics import delivery_ratio
from emulator.records.recorded_run import OpenedRun, RecordedRun
from emulator.records.reported import reported_figures
from emulator.records.run_folder import MANIFEST_FILE, SCENARIO_FILE, VERDICT_FILE
from emulator.records.tables import BACKBONE, DRIVEN, PAYLOADS, backbone_figures
from emulator.records.verdicts import (
    MOST_ROWS,
    CheckResult,
    Finding,
    Judgement,
    NotExercised,
    Verdict,
    invalid,
    named,
    not_exercised,
    result,
    unknown,
)
from emulator.scenario.faults import Corrupt, OwnRule, SenderFault
from emulator.scenario.loading import parse_toml
from emulator.scenario.own_functions import are_here, declared_checks
from vnet.counted import counted

FIRST_WITH_MANIFEST = 3
"""Format of the first folders that have a manifest."""
FILES = "files"
NO_PERIOD = "no period was completed"
NOT_OF_THE_RUN = (FILES, "replay", "trace_sha256")
"""Checks that compare files, and have other findings once the run is over."""


@dataclass(frozen=True)
class FolderCheck:
    """One check of a folder, and its row of the reference page; fields as those of `registry.Check`."""

    name: str
    function: Callable[[OpenedRun], Finding]
    claims: str
    invalid: str
    not_applicable: str = ""


ROUNDED_S = 0.001
"""Digits that verdict.json keeps of the run's wall-clock time."""


def kept(unkept: Sequence[str]) -> list[Finding]:
    """Return, at the end of a run, the finding that the disk has refused files; none if it has kept all."""
    return [named(FILES, unknown(f"not kept: {'; '.join(unkept)}", unkept=list(unkept)))] if unkept else []


def check_files(recorded: OpenedRun) -> Finding:
    """Check that each file is the one whose digest the manifest has."""
    digests = read_manifest(recorded.folder)
    if digests is None:
        if recorded.record.format < FIRST_WITH_MANIFEST:
            return not_exercised(f"a folder of format {recorded.record.format} has no manifest")
        return invalid(f"there is no {MANIFEST_FILE}")
    differing = differing_files(recorded.folder, digests)
    for check in recorded.record.checks if not differing else ():
        if check.name == FILES and check.figures.get("unkept"):
            return unknown(check.text, **check.figures)  # whatever verdict the file gives itself
    first = next((f"{name} {what}" for name, what in differing.items()), "")
    rows = [{"file": name, "what": what} for name, what in differing.items()]
    text = f"{counted(len(digests), 'file')} as they were written"
    return result(len(rows), text, f"{counted(len(rows), 'file')} other than written: {first}", rows)


def verdict_figures(recorded: RecordedRun, rows: Sequence[Any]) -> dict[str, Any]:
    """Return the figures of verdict.json that follow from the other files; `rows` are those of the metrics."""
    scenario = recorded.scenario
    count = len(recorded.node_ids) or len(recorded.world.node_ids if recorded.world is not None else ())
    return {
        "emulated_s": min(len(rows) * scenario.period_ns, scenario.duration_ns) / 1e9,
        "seed": scenario.run.seed,
        "vehicles": count - len(scenario.roadside),
        "roadside_units": len(scenario.roadside),
        "packet_delivery_ratio": delivery_ratio(recorded),
        "figures": summarize(rows),
        "driving": driving_figures(recorded.table(DRIVEN), recorded.events),
        "backbone": backbone_figures(recorded.table(BACKBONE)),
        "reported": {name: asdict(figure) for name, figure in reported_figures(recorded.states).items()},
    }


def check_payloads(recorded: OpenedRun) -> Finding:
    """Check that the payload of each frame is the one whose digest the trace has."""
    if not recorded.scenario.run.keep_payloads:
        return not_exercised("run.keep_payloads is false")
    if any(isinstance(planned.fault, (SenderFault, Corrupt, OwnRule)) for planned in recorded.plan):
        return not_exercised("faults change what is sent or received")
    kept, first = recorded.payloads, _sent_frames(recorded)
    digests, node_ids = recorded.digest, recorded.node_ids
    frames = [(node_ids[recorded.sender[row]], int(recorded.seq[row]), int(digests[row])) for row in first.tolist()]
    wrong = [
        {"sender": sender, "seq": seq}
        for sender, seq, digest in frames
        if kept is None or kept.of(sender, seq, (digest,)) is None
    ]
    text = f"payloads of {counted(len(frames), 'frame')} as they were sent"
    return result(len(wrong), text, f"{counted(len(wrong), 'frame')} with another payload", wrong[:MOST_ROWS])


def check_verdict_file(recorded: OpenedRun, judgement: Judgement) -> Finding:
    """Check that verdict.json has the figures that the other files give, and the verdict that its checks give."""
    record = recorded.record
    if record.format == 1:
        return not_exercised("figures of a folder of format 1 meant something else")
    kept_figures = _plain(record)
    computed = verdict_figures(recorded, rows_of(recorded.metrics)) | dict(_of_the_course(recorded))
    if record.format < 4:  # which left out some
        computed["figures"] = {name: value for name, value in computed["figures"].items() if name in record.figures}
    wrong = [
        {"figure": path, "kept": ours, "computed": theirs}
        for each, value in computed.items()
        for path, ours, theirs in differences(kept_figures[each], _plain(value), each)
    ]
    if record.format >= 3:
        wrong += _wrong_commands(recorded)
    wrong += _wrong_counts(recorded)
    wrong += _wrong_checks(recorded, judgement)
    if record.verdict is not (summed := record.judgement.verdict):
        wrong.append({"figure": "verdict", "kept": record.verdict.value, "computed": summed.value})
    text = f"{VERDICT_FILE} has what the other files give"
    first = f", first {wrong[0]['figure']}" if wrong else ""
    return result(len(wrong), text, f"{counted(len(wrong), 'figure')} other than the files give{first}", wrong)


def _of_the_course(recorded: OpenedRun) -> Iterator[tuple[str, Any]]:
    """Yield what events and figures say of the run's wall clock."""
    wall_s = [event.details.get("wall_s") for event in recorded.event(EventKind.ended)]
    start_up_s = [event.details.get("start_up_s") for event in recorded.event(EventKind.started)]
    yield "wall_s", wall_s[-1] if wall_s else None
    yield "start_up_s", start_up_s[0] if start_up_s else None
    seconds, told = recorded.record.wall_s, recorded.record.real_time_factor
    if seconds > 0:
        factor = recorded.record.emulated_s / seconds
        rounding = ROUNDED_S * factor / seconds + ROUNDED_S
        yield "real_time_factor", told if told is not None and abs(told - factor) <= rounding else round(factor, 3)


def _wrong_commands(recorded: OpenedRun) -> Iterator[dict[str, Any]]:
    """Yield what verdict.json says of the scenario's order of events, and the command that runs it again."""
    run, order = recorded.scenario.run, recorded.record.order
    told = (order or {}).get("kind", "fifo"), (order or {}).get("seed", run.order_seed)
    due = "tape" if run.tape is not None else run.order, run.order_seed
    if told != due:
        yield {"figure": "order", "kept": told, "computed": due}
    scenario, kept = shlex.quote(str(recorded.folder.absolute() / SCENARIO_FILE)), recorded.record.reproduce
    commands = [f"vnet {command} {scenario}" for command in ("simulate", "run")]
    if re.sub(r" --program MODULE:FUNCTION| --check-determinism(=portable)?", "", kept) not in commands:
        yield {"figure": "reproduce", "kept": kept, "computed": commands[0]}


def _wrong_counts(recorded: OpenedRun) -> list[dict[str, Any]]:
    """Return the numbers of frames and receptions that are not those of the trace."""
    wrong: dict[str, tuple[Any, Any]] = {}
    outcomes, counts = np.unique(recorded.trace["outcome"].to_numpy(), return_counts=True)
    rows = dict(zip(outcomes.tolist(), counts.tolist(), strict=True))
    record = recorded.record
    for outcome in {*rows, *record.frames_by_outcome} - {"out_of_range"}:
        if (count := record.frames_by_outcome.get(outcome, 0)) != rows.get(outcome, 0):
            wrong[f"frames_by_outcome.{outcome}"] = count, rows.get(outcome, 0)
    if record.cost is not None:
        wrong |= _wrong_payloads(recorded, record.cost)
        unseen = record.cost.payload.frames - len(_sent_frames(recorded))  # nobody was in range of them
        count, due = record.frames_by_outcome.get("out_of_range", 0), _out_of_range(recorded, unseen)
        copied = unseen > 0 and any(isinstance(planned.fault, SenderFault) for planned in recorded.plan)
        if count < due if copied else count != due:
            wrong["frames_by_outcome.out_of_range"] = count, due
    return [{"figure": what, "kept": ours, "computed": theirs} for what, (ours, theirs) in wrong.items()]


def _wrong_payloads(recorded: OpenedRun, cost: RunCost) -> dict[str, tuple[Any, Any]]:
    """Return the numbers and sizes of frames that are not those of the trace; it has not those out of all range."""
    first = _sent_frames(recorded)
    sizes = recorded.column("size_bytes")[first]
    due = run_cost(Costs(), recorded.node_ids, recorded.sender[first], sizes, len(recorded.node_ids))
    of_node = {vehicle.node: vehicle.payload for vehicle in due.vehicles}
    seen = dict(zip(recorded.node_ids, recorded.places.always_in_range.tolist(), strict=True))
    told = [("cost.payload", cost.payload, due.payload, all(seen.values()))]
    for vehicle in cost.vehicles:
        payload = of_node.get(vehicle.node, PayloadSizes(-1))
        told.append((f"cost of {vehicle.node}", vehicle.payload, payload, seen.get(vehicle.node, True)))
    return {
        what: (asdict(ours), asdict(theirs))
        for what, ours, theirs, exact in told
        if (ours != theirs if exact else ours.frames < theirs.frames)
    }


def _sent_frames(recorded: RecordedRun) -> NDArray[np.intp]:
    """Return the first row of each transmission of a frame by its program."""
    number = recorded.emission * (int(recorded.attempt.max(initial=0)) + 1) + recorded.attempt
    first = np.unique(number, return_index=True)[1]
    return np.asarray(first[recorded.copy[first] == 0], dtype=np.intp)


def _out_of_range(recorded: RecordedRun, unseen: int) -> int:
    """Return how many receptions were out of range; so are all of the frames that the trace has not."""
    broadcast = ~received_twice(recorded) & (recorded.attempt == 0)
    frames = len(np.unique(recorded.emission[broadcast])) + unseen
    single = int(((recorded.attempt > 0) & recorded.outcome_is("out_of_range")).sum())
    return frames * (len(recorded.node_ids) - 1) - int(broadcast.sum()) + single


def _wrong_checks(recorded: OpenedRun, judgement: Judgement) -> list[dict[str, Any]]:
    """Return the checks of verdict.json that are not those that the files give; own ones stand as recorded."""
    record, program = recorded.record, recorded.scenario.program
    wrong = []
    ours = _by_name(record.judgement)
    theirs = _by_name(judgement)
    of_tests = [event.details.get("checks") for event in recorded.event(EventKind.judged_by_test)]
    asked = {name for names in of_tests if isinstance(names, list) for name in names if isinstance(name, str)}
    silent = not program.checks and are_here(program) and not declared_checks(program)
    for name in ours:
        if name.startswith(PREFIX) and silent and name not in asked:
            wrong.append({"figure": name, "kept": "a check of your own", "computed": "the scenario has none"})
    code = parse_toml(recorded.scenario_text).get("code")
    if not isinstance(code, dict) or code.get("vnet") != vnet_digest():  # another vnet may have judged otherwise
        return wrong
    for name, check in ours.items():
        if name.startswith(PREFIX):
            continue
        if name not in theirs:
            wrong.append({"figure": name, "kept": "a check", "computed": "no such check"})
        elif differing := next(differences(_plain(check), _plain(theirs[name]), name), None):
            wrong.append(dict(zip(("figure", "kept", "computed"), differing, strict=True)))
    missing = [name for name in theirs if name not in ours and not name.startswith(PREFIX)]
    return [*wrong, *({"figure": name, "kept": None, "computed": "a check"} for name in missing)]


def _by_name(judgement: Judgement) -> dict[str, Finding]:
    """Return the findings on a run by name, without those that compare files."""
    findings: list[Finding] = [*judgement.checks, *judgement.not_exercised]
    return {finding.name: finding for finding in findings if finding.name not in NOT_OF_THE_RUN}


def differences(ours: Any, theirs: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield path and both values wherever two values as JSON has them differ by more than rounding."""
    if isinstance(ours, Mapping) and isinstance(theirs, Mapping):
        for name in {**ours, **theirs}:
            yield from differences(ours.get(name), theirs.get(name), f"{path}.{name}")
    elif isinstance(ours, list) and isinstance(theirs, list) and len(ours) == len(theirs):
        for index, (mine, other) in enumerate(zip(ours, theirs, strict=True)):
            yield from differences(mine, other, f"{path}.{index}")
    elif isinstance(ours, float) or isinstance(theirs, float):
        numbers = isinstance(ours, (int, float)) and isinstance(theirs, (int, float))
        if not numbers or not math.isclose(ours, theirs, rel_tol=1e-9, abs_tol=1e-9):
            yield path, ours, theirs
    elif ours != theirs:
        yield path, ours, theirs


def _plain(value: Any) -> Any:
    """Return a value as JSON holds it."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {name: getattr(value, name) for name in value.__dataclass_fields__}
    if isinstance(value, Mapping):
        return {str(name): _plain(each) for name, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(each) for each in value]
    if isinstance(value, np.ndarray):
        return value.tolist()
    return value.item() if isinstance(value, np.generic) else value


FOLDER_CHECKS = (
    FolderCheck(
        FILES,
        check_files,
        f"Each file is the one whose SHA-256 `{MANIFEST_FILE}` has. A run itself is unknown "
        "if the disk refused one.",
        "a file has other contents, is missing, or is not in the manifest",
        "a folder of format 1 or 2, which has no manifest",
    ),
    FolderCheck(
        "truth",
        checked_world,
        "Positions, headings, common errors, fixes (with the faults of receivers) and `world.npz` are those that "
        "the scenario and its seed give, to 1e-6 m.",
        "another position, heading, common error or fix",
        "the world comes from files, from a function of yours, or from programs that drive",
    ),
    FolderCheck(
        "payloads",
        check_payloads,
        f"`{PAYLOADS.file}` has the payload of each frame of the trace, by its digest.",
        "another payload, or none",
        "a run without `run.keep_payloads`, or with faults that change what is sent or received",
    ),
    FolderCheck(
        "metrics",
        check_metrics,
        "The metrics of each period are those of the states, and `metrics_sha256` is their hash.",
        "another figure",
        "no period was completed",
    ),
    FolderCheck(
        "outcomes",
        check_outcomes,
        "The radio is given the frames of the trace once more: each has the same receivers, outcomes, causes and "
        "arrivals, each fault the same copies, and each vehicle the same channel busy ratios.",
        "another reception",
        "real time, an order of events other than FIFO, a run that was cut short, frames to single vehicles, "
        "powers or bit rates of programs, rules of your own, `StaleMessages`, and, with a MAC or copies, frames "
        "that nobody was in range of",
    ),
)
"""Checks of a folder by themselves; `verdict_file` comes last, as it compares what all others have found."""
VERDICT_FILE_CHECK = FolderCheck(
    "verdict_file",
    lambda recorded: not_exercised("judged with all others"),
    f"`{VERDICT_FILE}` has the figures, the numbers of frames and vehicles, and the checks that the other files "
    "give.",
    "another figure, or a check that the files do not give",
    "a folder of format 1",
)


def judge_folder(recorded: OpenedRun, judgement: Judgement) -> None:
    """Add the findings of the checks of a folder to those of its run."""
    findings: list[Finding] = [named(FILES, check_files(recorded))]
    if len(recorded.states):
        findings += [named(check.name, check.function(recorded)) for check in FOLDER_CHECKS[1:]]
        findings.append(named(VERDICT_FILE_CHECK.name, check_verdict_file(recorded, judgement)))
    else:
        findings += [NotExercised(check.name, NO_PERIOD) for check in (*FOLDER_CHECKS[1:], VERDICT_FILE_CHECK)]
    for finding in findings:
        judgement.put(_of_earlier_format(finding) if recorded.record.format < FIRST_WITH_MANIFEST else finding)


def _of_earlier_format(finding: Finding) -> Finding:
    """Return a finding on a folder of an earlier vnet, which did not make this check: it makes no run invalid."""
    if isinstance(finding, NotExercised) or finding.verdict is not Verdict.INVALID:
        return finding
    return CheckResult(
        finding.name, Verdict.UNKNOWN, f"{finding.text}; the folder is of an earlier format", finding.figures
    )
