"""Tables of links over time: what they say, on the radio and in whole runs, and what is wrong with them."""

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.checks.judge import judge
from emulator.export.tables import measured_links
from emulator.radio.engine import Engine
from emulator.radio.topology import Measured, connectivity_of
from emulator.records.recorded_run import RecordedRun
from emulator.scenario.scenario import Radio, Scenario
from emulator.world.radio_inputs import LinkTable, RadioInputs, load_links
from tests.emulator.checks.test_judge import run_scenario
from tests.support.motion import along, scenario_of_trips, still, write_trips
from vnet import Node
from vnet.errors import ScenarioError

S = 1_000_000_000
HEAD = "time_s,sender,receiver,loss\n"
NAMES = ["a", "b", "c"]


def table(*rows: tuple[float, int, int, float | None]) -> LinkTable:
    time_s, sender, receiver, loss = zip(*rows, strict=True)
    losses = np.array([np.nan if each is None else each for each in loss])
    return LinkTable((np.array(time_s) * S).astype(np.int64), np.array(sender), np.array(receiver), losses)


def test_losses_of_the_table_and_of_the_scenario_exclude_each_other(tmp_path: Path) -> None:
    (tmp_path / "links.csv").write_text(HEAD + "0,a,b,0\n")
    with pytest.raises(ScenarioError, match=r"^radio\.loss = 0\.1: must be 0, because .*links\.csv has the losses"):
        load_links(Radio(links=tmp_path / "links.csv", loss=0.1), NAMES)


def test_columns_may_stand_in_any_order_and_others_beside_them(tmp_path: Path) -> None:
    path = tmp_path / "links.csv"
    path.write_text("loss,remark,receiver,sender,time_s\n0.5,x,b,a,0\n,y,b, a ,1.5\n")
    found = load_links(Radio(links=path), NAMES)
    assert isinstance(found, LinkTable)
    assert found.time_ns.tolist() == [0, 1_500_000_000] and found.sender.tolist() == [0, 0]
    assert found.receiver.tolist() == [1, 1] and found.loss[0] == 0.5 and np.isnan(found.loss[1])


rows = st.lists(
    st.tuples(st.integers(0, 6), st.permutations(range(4)), st.sampled_from([None, 0.0, 0.25, 1.0])), max_size=25
)


@pytest.mark.slow
@given(rows, st.lists(st.integers(0, 7), min_size=1, max_size=8), st.permutations(range(4)))
def test_a_row_holds_until_the_next_of_its_pair_in_whatever_order_times_are_asked(
    drawn: list[tuple[int, list[int], float | None]], asked_s: list[int], gone: list[int]
) -> None:
    last = {(time_s, ends[0], ends[1]): loss for time_s, ends, loss in drawn} or {(0, 0, 1): 0.5}
    ordered = sorted(last.items(), key=lambda item: item[0])
    links = table(*((*key, loss) for key, loss in ordered))
    position_m = np.random.default_rng(1).uniform(0, 100, (4, 2))
    position_m[gone[0]] = np.nan
    subject = connectivity_of(Radio(), 1, RadioInputs(links))
    for time_s in asked_s:
        subject = subject.at(time_s * S)
        holds: dict[tuple[int, int], float | None] = {}
        for (row_s, sender, receiver), loss in ordered:
            if row_s <= time_s:
                holds[sender, receiver] = loss
        known = {pair: loss for pair, loss in sorted(holds.items()) if loss is not None and gone[0] not in pair}
        pairs = subject.links(position_m)
        assert list(zip(pairs.sender.tolist(), pairs.receiver.tolist(), strict=True)) == list(known)
        losses = subject.losses(pairs.sender, pairs.receiver)
        assert losses is not None and losses.tolist() == list(known.values())
        assert (subject.in_range(position_m, np.zeros((4, 4))) == pairs.matrix()).all()
    assert isinstance(subject, Measured) and np.isnan(subject.losses(np.array([3]), np.array([3])))


@pytest.mark.parametrize("count", [3, 70], ids=["matrices", "neighbours"])
@pytest.mark.parametrize("mac", [None, {}], ids=["", "medium"])
def test_frames_take_the_links_of_the_time_at_which_they_are_sent(count: int, mac: dict[str, Any] | None) -> None:
    links = table((0, 0, 1, 0.0), (1, 0, 1, 1.0), (1.5, 0, 2, 0.0), (2, 0, 1, None), (3, 0, 1, 0.0))
    radio = Radio.model_validate({"access_jitter_ms": 0, "mac": mac})
    position_m = np.column_stack([np.arange(count) * 50.0, np.zeros(count)])
    subject = Engine([f"v{n}" for n in range(count)], radio, 1, position_m, RadioInputs(links))
    late = () if mac is not None else (S // 2,)  # in real time perhaps out of order
    for time_ns in (0, S - 1, S, 2 * S - 1, 2 * S, 3 * S, *late):
        subject.transmit(time_ns, 0, [b"x"])
        if time_ns == S - 1:
            subject.set_positions(position_m + 1.0)
    subject.drain()
    found = [(r["sent_ns"], r["receiver"], r["outcome"]) for r in subject.trace.to_table().to_pylist()]
    assert sorted(found) == [
        (0, "v1", "delivered"),
        *((time_ns, "v1", "delivered") for time_ns in late),
        (S - 1, "v1", "delivered"),
        (S, "v1", "lost"),
        (2 * S - 1, "v1", "lost"),
        (2 * S - 1, "v2", "delivered"),
        (2 * S, "v2", "delivered"),
        (3 * S, "v1", "delivered"),
        (3 * S, "v2", "delivered"),
    ]


@pytest.mark.slow
def test_a_link_loses_the_share_that_its_row_says() -> None:
    links = table((0, 0, 1, 0.2), (0, 0, 2, 0.7))
    subject = Engine(NAMES, Radio(access_jitter_ms=0, queue_frames=9999), 1, np.zeros((3, 2)), RadioInputs(links))
    for number in range(2000):
        subject.transmit(number * 1_000_000, 0, [b"x"])
    subject.drain()
    got = [row["receiver"] for row in subject.trace.to_table().to_pylist() if row["outcome"] == "delivered"]
    assert got.count("b") == pytest.approx(1600, abs=90) and got.count("c") == pytest.approx(600, abs=100)


# From a run to its replay.

VEHICLES: dict[str, list[Any]] = {
    "a": [(0, 5, along(0, 40))],
    "b": [(0, 5, still(60, 10))],
    "c": [(0, 5, along(300, -30))],
    "d": [(0, 2.5, still(90)), (4.5, 6, still(90))],
}


async def chatters(node: Node) -> None:
    """Send several frames a period, at times of one's own."""
    pause_s = 0.031 + 0.003 * (ord(node.id[0]) - ord("a"))
    while True:
        await node.radio.broadcast(node.id.encode() * 20)
        await asyncio.sleep(pause_s)


def measured_scenario(folder: Path, **radio: Any) -> Scenario:
    trips = write_trips(folder / "trips.csv", VEHICLES)
    return scenario_of_trips(trips, 4.0, program=f"{__name__}:chatters", radio={"loss": 0.0, **radio})


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """A run in which links fade and vehicles go out of range, and out of the network."""
    folder = tmp_path_factory.mktemp("measured")
    weak = {"kind": "log_distance", "tx_power_dbm": 3.0, "floor_dbm": -92.0}
    radio = {"path_loss": weak, "fading": {}, "max_peers": 2}
    run_scenario(folder / "run", measured_scenario(folder, **radio))
    return RecordedRun.open(folder / "run")


def write(path: Path, links: LinkTable, names: list[str]) -> None:
    lines = [
        f"{time_ns / S:.9f},{names[sender]},{names[receiver]},{'' if np.isnan(loss) else loss}"
        for time_ns, sender, receiver, loss in zip(
            *(each.tolist() for each in (links.time_ns, links.sender, links.receiver, links.loss)), strict=True
        )
    ]
    path.write_text(HEAD + "\n".join(lines) + "\n")


def replay(folder: Path, links: LinkTable, measured: RecordedRun, **radio: Any) -> RecordedRun:
    """Run the vehicles of `measured` with these links."""
    write(folder / "links.csv", links, measured.node_ids)
    return run_scenario(folder / "run", measured_scenario(folder, links=str(folder / "links.csv"), **radio))


def verdicts(recorded: RecordedRun) -> dict[str, str]:
    return {check.name: check.verdict.value for check in judge(recorded).checks}


def arrivals(recorded: RecordedRun) -> dict[tuple[Any, ...], bool]:
    """Return whether each reception in range arrived, by sender, frame and receiver."""
    arrived = ("delivered", "receiver_down")
    return {
        (r["sender"], r["seq"], r["sent_ns"], r["receiver"]): r["outcome"] in arrived
        for r in recorded.trace.to_pylist()
    }


@pytest.mark.slow
def test_a_row_for_each_frame_replays_exactly_what_was_received(measured: RecordedRun, tmp_path: Path) -> None:
    links = measured_links(measured, 0)
    assert set(links.loss[~np.isnan(links.loss)].tolist()) == {0.0, 1.0} and np.isnan(links.loss).any()
    replayed = replay(tmp_path, links, measured, max_peers=2)
    assert arrivals(replayed) == arrivals(measured)
    assert 100 < sum(arrivals(measured).values()) < 0.9 * len(arrivals(measured))
    assert [verdicts(replayed)[name] for name in ("conservation", "range", "loss_rate")] == ["valid"] * 3
    assert verdicts(replayed)["peer_cap"] in ("valid", "unknown")
    again = measured_links(replayed, 0)
    for column in ("time_ns", "sender", "receiver"):
        assert getattr(again, column).tolist() == getattr(links, column).tolist()
    assert np.array_equal(again.loss, links.loss, equal_nan=True)


@pytest.mark.slow
def test_a_row_for_each_second_replays_the_same_share(measured: RecordedRun, tmp_path: Path) -> None:
    links = measured_links(measured, S)
    assert len(links.time_ns) < 60
    replayed = replay(tmp_path, links, measured)
    assert [verdicts(replayed)[name] for name in ("conservation", "range", "loss_rate")] == ["valid"] * 3
    before, after = arrivals(measured), arrivals(replayed)
    assert before.keys() == after.keys(), "the same receptions are attempted"
    losses = replayed.places.pair_losses(replayed.sender, replayed.receiver, replayed.sent_ns)
    assert losses is not None and sum(before.values()) == pytest.approx(float((1 - losses).sum()))
    deviation = float(np.sqrt((losses * (1 - losses)).sum()))
    assert sum(after.values()) == pytest.approx(sum(before.values()), abs=4 * deviation)


@pytest.mark.slow
def test_what_is_lost_on_a_link_that_loses_nothing_is_found(measured: RecordedRun, tmp_path: Path) -> None:
    sound = replay(tmp_path, table((0, 0, 1, 0.0), (0, 1, 0, 1.0)), measured)
    outcome = sound.trace["outcome"].to_pylist()
    assert outcome.count("lost") > 20 and outcome.count("delivered") > 20
    changed = LinkTable(*(np.array(each) for each in ([0, 0], [0, 1], [1, 0], [1.0, 0.0])))
    assert sound.world is not None
    world = replace(sound.world, radio_inputs=RadioInputs(links=changed))
    claimed = RecordedRun(sound.scenario, sound.trace, sound.states, sound.metrics, sound.events, world=world)
    for recorded, verdict in ((sound, "valid"), (claimed, "invalid")):
        assert verdicts(recorded)["loss_rate"] == verdict
