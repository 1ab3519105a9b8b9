"""Episodes: runs whose vehicles await what agents outside of the run have them do.

The run is simulated on a thread of its own. A microsecond after the fixes of each period it stops, in the midst of
emulated time, with what agents have observed, and goes on when it is told what each is to do.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Awaitable, Callable, Mapping, Sequence
from contextvars import Context, copy_context
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from emulator.drivers.emulation import Emulation
from emulator.drivers.session import Session
from emulator.records.events import Event
from emulator.records.run_folder import RunFolder
from emulator.scenario.scenario import Scenario
from vnet.node import Fix, Node
from vnet.radio import Packet
from vnet.runtime.own_asyncio import current_node
from vnet.runtime.programs import given_programs
from vnet.types import Array
from vnet.units import NS_PER_S

Observe = Callable[[Node, Fix, Sequence[Packet]], Any]
Act = Callable[[Node, Any], Awaitable[None] | None]
Reward = Callable[[str, "Moment"], float]
Ends = Callable[[str, "Moment"], bool]

ENTRY = "emulator.learning.episode:vehicle"
"""Entry by which a scenario names the program of agents."""
THINKING_S = 1e-6
"""Emulated time from the fixes of a period to what agents do."""
FOR_EVER_S = 1e9
"""Emulated time that no run takes."""
NO_REPLAY = "not warranted: what vehicles did was decided outside of the run"


@dataclass(frozen=True)
class Moment:
    """The truth at the end of a step, from which rewards are made; programs never see it.

    time_s: emulated seconds since the start of the run.
    position_m: (2,) in m east-north, by node, read-only; NaN for a vehicle that is not there.
    speed_m_s: speed by node, from the way since the step before (0 in its first); NaN as above.
    events: what has happened since the step before, such as `collision`.
    actions: what each agent did in this step; one that had observed nothing at its beginning did nothing.
    """

    time_s: float
    position_m: Mapping[str, Array]
    speed_m_s: Mapping[str, float]
    events: Sequence[Event]
    actions: Mapping[str, Any]


@dataclass(frozen=True)
class Behaviour:
    """The functions that the user gives."""

    observe: Observe
    act: Act
    reward: Reward
    terminated: Ends


@dataclass(frozen=True)
class Turn:
    """Observations of agents at one instant, by node; or that the run is over, and by which error.

    events: what has happened since the turn before.
    """

    time_ns: int
    observed: Mapping[str, Any]
    events: Sequence[Event]
    over: bool = False
    error: BaseException | None = None


class Episode:
    """One run: `next_turn` waits for agents to have observed, `answer` lets them act, `close` ends it."""

    def __init__(self, scenario: Scenario, behaviour: Behaviour, out: Path | None) -> None:
        self._behaviour = behaviour
        self._scratch = TemporaryDirectory(prefix="vnet-episode-") if out is None else None
        self._session = Session(
            scenario, out if self._scratch is None else RunFolder.scratch(Path(self._scratch.name))
        )
        self.emulation = self._session.emulation
        self._keeps = out is not None
        if self._keeps:
            self._session.folder.open(self.emulation.scenario)
        self._asking: dict[str, tuple[int, Any, asyncio.Future[Any]]] = {}
        self._told = 0  # events
        self._turn_ns = -1  # the latest turn is of the fixes of this instant
        self._known: set[str] = set()  # agents that have ever observed
        self._turns: SimpleQueue[Turn] = SimpleQueue()
        self._answers: SimpleQueue[Mapping[str, Any] | None] = SimpleQueue()
        self._stop = threading.Event()
        self.finished: set[str] = set()
        """Agents whose episode is over: their programs await nothing any more."""
        within = copy_context().run
        self._thread = threading.Thread(target=within, args=(self._run,), name="vnet episode", daemon=True)
        self._thread.start()

    # On the caller's thread.

    @staticmethod
    def agents_of(scenario: Scenario, node_ids: Sequence[str]) -> list[str]:
        """Return the ids of the vehicles that are agents, present or not."""
        return [node for node in node_ids if scenario.program.of(node).entry == ENTRY]

    def next_turn(self) -> Turn:
        """Return what agents have observed, or that the run is over. Raises what has ended it."""
        turn = self._turns.get()
        if turn.error is not None:
            raise turn.error
        return turn

    def answer(self, actions: Mapping[str, Any]) -> None:
        """Let the agents that have observed act; those without an action do nothing in this step."""
        self._answers.put(actions)

    def close(self) -> None:
        """End the run, wherever it is."""
        self._stop.set()
        self._answers.put(None)
        self._thread.join()
        if self._scratch is not None:
            self._scratch.cleanup()

    # On the run's thread.

    def _run(self) -> None:
        try:
            with given_programs({ENTRY: self._vehicle}):
                self._session.run(stop=self._stop)
            last = Turn(self.emulation.emulated_ns, {}, self._events(), over=True)
            if self._keeps:
                self._session.close(NO_REPLAY)
        except BaseException as error:
            last = Turn(0, {}, (), over=True, error=error)
        self._turns.put(last)

    def _events(self) -> Sequence[Event]:
        """Return the events since the last call."""
        new = self.emulation.folder.events[self._told :]
        self._told += len(new)
        return new

    async def _vehicle(self, node: Node) -> None:
        """The program of an agent; started again after a kill, it is none any more."""
        if node.id in self._known:
            return
        async for fix in node.gnss:
            if node.id in self.finished:
                return
            *_, newest = fix, *node.gnss.drain()  # after a pause there are several
            if newest.time_ns <= self._turn_ns:
                continue  # what is heard until the next one is observed with that
            try:
                observation = self._behaviour.observe(node, newest, node.radio.drain())
                answered, action = await self._await_action(node.id, newest.time_ns, observation)
                if answered and (doing := self._behaviour.act(node, action)) is not None:
                    await doing
            except Exception as error:  # whoever learns is to know, and not only the run's verdict
                self._turns.put(Turn(newest.time_ns, {}, (), over=True, error=error))
                raise

    async def _await_action(self, node: str, fix_time_ns: int, observation: Any) -> tuple[bool, Any]:
        """Return whether the agent does anything, and what."""
        loop = asyncio.get_running_loop()
        if not self._known:
            nobodys = Context()  # no fault stops its timers, or sets its clock
            nobodys.run(current_node.set, None)
            loop.call_soon(self._schedule, loop, fix_time_ns, context=nobodys)
        self._known.add(node)
        future: asyncio.Future[tuple[bool, Any]] = loop.create_future()
        self._asking[node] = fix_time_ns, observation, future
        answer = await future
        if self._stop.is_set():  # the run ends with this window, and its programs as if they still acted
            await asyncio.sleep(FOR_EVER_S)
        return answer

    def _schedule(self, loop: asyncio.AbstractEventLoop, time_ns: int) -> None:
        """Take the turn of the fixes of an instant."""
        loop.call_at(time_ns / NS_PER_S + THINKING_S, self._take_turn, loop, time_ns)

    def _take_turn(self, loop: asyncio.AbstractEventLoop, time_ns: int) -> None:
        """Stop emulated time until the caller has answered; once a period, whoever has observed.

        While all vehicles are paused no timer fires; those turns are then made up for.
        """
        if self._stop.is_set():
            return
        self._turn_ns = time_ns
        self._schedule(loop, time_ns + self.emulation.world.period_ns)
        waiting = {node: each for node, each in self._asking.items() if not each[2].done()}  # not killed programs
        now = {node: each for node, each in waiting.items() if each[0] <= time_ns}
        self._asking = {node: each for node, each in waiting.items() if node not in now}
        observed = {node: observation for node, (_, observation, _) in now.items()}
        self._turns.put(Turn(time_ns, observed, self._events()))
        answers = self._answers.get() or {}
        for node, (_, _, future) in now.items():
            future.set_result((node in answers, answers.get(node)))


class Scenes:
    """The truth of an episode from step to step."""

    def __init__(self, emulation: Emulation) -> None:
        self._emulation = emulation
        self._period = 0
        self._speed = 0.0 * emulation.world.position_m(0)[:, 0]  # NaN for those that are not there

    def moment(self, turn: Turn, actions: Mapping[str, Any]) -> Moment:
        """Return the moment of a step that ends with `turn`."""
        world = self._emulation.world
        period = min(turn.time_ns // world.period_ns, world.last_known_period)
        if period > self._period:
            way_m = world.position_m(period) - world.position_m(self._period)
            passed_s = (period - self._period) * world.period_ns / NS_PER_S
            speed, self._period = np.hypot(way_m[:, 0], way_m[:, 1]) / passed_s, period
            has_entered = np.isnan(speed) & ~np.isnan(world.position_m(period)[:, 0])
            self._speed = np.where(has_entered, 0.0, speed)
        position_m = world.position_m(period).copy()
        position_m.flags.writeable = False  # one for the functions of all agents
        return Moment(
            period * world.period_ns / NS_PER_S,
            dict(zip(world.node_ids, position_m, strict=True)),
            dict(zip(world.node_ids, self._speed.tolist(), strict=True)),
            turn.events,
            actions,
        )
