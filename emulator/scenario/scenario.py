"""The scenario file: what a run is made of, read from TOML, checked by pydantic.

One frozen model a section. What is wrong becomes a `ScenarioError` of one line: file, key, value, what is allowed.
"""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from emulator.scenario.faults import AnyFault, Fault
from emulator.scenario.network import LIBSUMO, OSM_ENDINGS, Driven, Map, Network, Ranging, control_step_ns
from emulator.scenario.program import PYTHON_NAME, Backbone, Entry, Program, RoadsideUnit, Ros2Topics, with_names
from emulator.scenario.radio import (
    RATES_MBPS,
    Buildings,
    Congestion,
    CrLimit,
    Edca,
    Fading,
    Mac,
    PathLoss,
    Receiver,
    Shadowing,
    Sidelink,
)
from emulator.scenario.sections import DAY_S, FAR_M, FAR_S, WILD_M, Section, Switch
from vnet.errors import ProgramError, ScenarioError, shown
from vnet.extras import require
from vnet.gateway import PYTHON_FLAGS, python_words
from vnet.units import NS_PER_MS, NS_PER_S, Grid


class CommonError(Section):
    """`[world.common_error]`: the GNSS error that all share, drawn or recorded."""

    kind: Literal["gauss_markov", "file"] = "gauss_markov"
    """`gauss_markov` draws a first-order Gauss-Markov process; `file` reads a recorded error from `path`."""
    sigma_m: float = Field(3.0, ge=0, le=WILD_M)
    """Its standard deviation in each axis: by default that of ionosphere and orbits, so that all fixes are some
    metres off in the same direction. For studies that are not about positioning: 0. Of a recorded error what the
    reference of a program assumes."""
    tau_s: float = Field(600.0, gt=0)
    """Its correlation time. Of a recorded error what the reference of a program assumes."""
    path: Path | None = None
    """`file`: CSV, relative to the scenario file, with the columns time_s, east_m, north_m; or of several receivers
    NAME_east_m and NAME_north_m each. Then their mean is common, and the rest is each receiver's own: vehicles
    have the receivers in turn. Between rows the error changes linearly."""
    start_s: float | None = Field(None, ge=-FAR_S, le=FAR_S)
    """`file`: at which time of the file the run begins; at its first row's if left out."""
    gradient_m_per_km: float = Field(0.0, ge=0, le=1000)
    """Standard deviation of each of the four components of the error's gradient, a Gauss-Markov process with
    `tau_s`: with it, the error is common in the middle of the area only."""

    @model_validator(mode="after")
    def _keys_go_with_their_kind(self) -> CommonError:
        if self.kind == "file" and self.path is None:
            raise ValueError('path is required with kind = "file"')
        if self.kind != "file" and (self.path is not None or self.start_s is not None):
            raise ValueError('path and start_s go with kind = "file"')
        return self


class Gnss(Section):
    """`[world.gnss]`: each vehicle's own receiver: its rate, its noise and its heading."""

    rate_hz: float = Field(10.0, ge=1 / DAY_S, le=1000)
    """Fixes a second. The time between two is the period by which states and metrics are recorded."""
    sigma_m: float = Field(1.0, ge=0, le=WILD_M)
    """Standard deviation of the receiver's noise in each axis."""
    multipath_sigma_m: float = Field(0.0, ge=0, le=WILD_M)
    """Standard deviation of multipath in each axis: a Gauss-Markov process of each vehicle's own."""
    multipath_tau_s: float = Field(60.0, gt=0)
    """Correlation time of the multipath."""
    outlier_probability: float = Field(0.0, ge=0, le=1)
    """Probability that a fix is an outlier, independently for each."""
    outlier_m: float = Field(30.0, ge=0, le=WILD_M)
    """Distance by which an outlier is displaced, in any direction."""
    covariance: Literal["noise", "total"] = "noise"
    """Covariance that fixes state: that of the receiver's `noise` alone, or in `total` with its multipath, of which
    they then state deviation and correlation time, too."""
    heading: Switch = True
    """True if fixes have a heading."""
    heading_sigma_rad: float = Field(0.01, ge=0, le=1)
    """Standard deviation of that heading."""
    heading_speed_sigma_mps: float = Field(0.0, ge=0, le=FAR_M)
    """Standard deviation of the speed across the course, from which a receiver computes its heading: divided by
    the vehicle's speed it adds to the heading's deviation, up to π."""
    heading_min_speed_mps: float = Field(0.0, ge=0, le=FAR_M)
    """Fixes of slower vehicles have no heading. Vehicles of a network of straight lanes stand."""
    speed_sigma_mps: float = Field(0.1, ge=0, le=FAR_M)
    """Standard deviation of the speed that fixes tell: by default that of Doppler measurements under open sky."""


class Lateral(Section):
    """`[world.lateral]`: how far a vehicle's centre strays from its lane's centre line."""

    half_width_m: float = Field(0.85, gt=0, le=WILD_M)
    """Largest lateral offset; programs know it from the map."""
    sigma_m: float = Field(0.4, ge=0, le=WILD_M)
    """Standard deviation of the offset, before it is reflected at the half-width."""
    tau_s: float = Field(20.0, gt=0)
    """Correlation time of the offset."""


class OwnSensor(Section):
    """`[world.sensor.NAME]`: a sensor of your own in each vehicle."""

    model: Entry
    """Function that is called each period with the truth and a state, and returns the readings of vehicles:
    `FILE.py:function` or `module:function`; a file's is `sensor` if left out."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Given to the model as `truth.options`; what is allowed is its own business."""


SensorName = Annotated[str, Field(pattern=r"^[A-Za-z][A-Za-z0-9_]{0,39}$")]


class WorldSection(Section):
    """`[world]`: the truth that the vehicles never see."""

    common_error: CommonError = CommonError()
    gnss: Gnss = Gnss()
    lateral: Lateral = Lateral()
    ranging: Ranging | None = None
    """Sensor of driven vehicles for the one ahead."""
    sensor: dict[SensorName, OwnSensor] = Field(default_factory=dict)
    """Sensors of your own, by name."""


def check_driving(driven: Driven, control_hz: float, period_ns: int, world: WorldSection) -> None:
    """Raise ValueError unless control instants, dynamics and GNSS errors fit together."""
    _check_control(control_hz, period_ns)
    if driven.max_speed_mps / control_hz >= 2 * driven.vehicle_length_m:
        raise ValueError(
            f"network.driven.max_speed_mps = {driven.max_speed_mps:g}: vehicles could pass through one another "
            f"between two control instants; less than {2 * driven.vehicle_length_m * control_hz:g} is needed"
        )
    if world.common_error.gradient_m_per_km:
        raise ValueError('world.common_error.gradient_m_per_km goes not with network.kind = "driven"')


def check_stepped_sumo(control_hz: float, period_ns: int, world: WorldSection) -> None:
    """Raise ValueError unless control instants are steps that SUMO can make, and GNSS errors fit."""
    _check_control(control_hz, period_ns)
    if control_step_ns(control_hz) % NS_PER_MS:
        raise ValueError(f"run.control_hz = {control_hz:g}: SUMO steps by whole milliseconds, so 10, 20, 50")
    if world.common_error.gradient_m_per_km:
        raise ValueError("world.common_error.gradient_m_per_km goes not with network.step = true")


def _check_control(control_hz: float, period_ns: int) -> None:
    if period_ns % control_step_ns(control_hz):
        raise ValueError(
            f"run.control_hz = {control_hz:g}: must be a whole multiple of world.gnss.rate_hz = "
            f"{NS_PER_S / period_ns:g}, with intervals of whole nanoseconds"
        )


MANY = 1_000_000_000


class Run(Section):
    """`[run]`: name, length and time limits of the run."""

    name: str = Field("run", pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")
    """Names the run's folder, and its keys on Zenoh."""
    seed: int = Field(1, ge=0, lt=2**63)
    """Seed of all random draws: the same seed, the same run."""
    duration_s: float = Field(30.0, ge=1e-9, le=DAY_S)
    """Length of the run, in emulated time."""
    world_s: float | None = Field(None, ge=1e-9, le=DAY_S)
    """Length for which the world is made, if that is longer, as where a test has ended its run."""
    settle_s: float = Field(5.0, ge=0, le=DAY_S)
    """Time without faults before the end (emulated time), so that the network is judged at rest."""
    pacing: Literal["lockstep", "realtime"] = "lockstep"
    """`lockstep` is virtual time, `realtime` the wall clock."""
    nodes_per_process: int = Field(1, ge=1, le=1000)
    """Vehicles that share an agent process; they start, pause and die together."""
    start: Literal["fork", "spawn"] = "fork"
    """Agent processes: `fork` them from one that has imported what they need (on Linux) or `spawn` interpreters."""
    join_timeout_s: float = Field(60.0, gt=0, le=DAY_S)
    """Time for agents to join, or to come back after a fault (wall clock)."""
    windows: Switch = True
    """Lockstep: processes run alone for as long as no frame sent meanwhile can arrive (`radio.latency_ms`), and not
    for one instant. The run is the same; `false` is for agents that know no windows."""
    order: Literal["fifo", "shuffle", "pct"] = "fifo"
    """Lockstep: in which order a vehicle is shown what happens at one instant. `shuffle` draws it, `pct` too, with
    priorities (docs/orders.md)."""
    order_seed: int = Field(1, ge=0, lt=2**63)
    """Draws the order, and nothing else."""
    order_depth: int = Field(3, ge=1, le=100)
    """`pct`: the number of events whose order matters in the bugs that are sought."""
    order_steps: int | None = Field(None, ge=1, le=MANY)
    """`pct`: decisions of a vehicle in a run; counted in a run in FIFO order if left out."""
    order_slack_us: int = Field(0, ge=0, le=MANY)
    """Lockstep: a vehicle's packets and timers are late by less than this, at one of four phases (`order_seed`
    modulo 4), so that an order also swaps what is nearly simultaneous. It divides the period of fixes."""
    tape: Path | tuple[str, ...] | None = None
    """Deviations from FIFO to follow, as far as they fit: the `tape.jsonl` of another run, relative to the scenario
    file, or a list of its lines. With `order = "fifo"`."""
    stall_timeout_s: float = Field(30.0, gt=0, le=DAY_S)
    """A process that makes no progress for so long (wall clock) ends the run as unknown; lockstep."""
    orphan_timeout_s: float = Field(5.0, gt=0, le=DAY_S)
    """An agent that has lost its emulator for so long (wall clock) ends."""
    spin_limit: int = Field(100_000, ge=100, le=MANY)
    """Rounds of callbacks that a process may take at one instant, or at instants 1 ns apart; more ends its spinning
    programs. Lockstep."""
    files_max_mb: float = Field(10.0, ge=0, le=1_000_000)
    """Megabytes of a vehicle's files (`node.folder`) that are kept in the run's folder, and 1000 files at most."""
    memory_limit_mb: float | None = Field(None, gt=0, le=1_000_000_000)
    """Megabytes of private memory that a process of programs may hold; more ends the run as unknown. No limit if
    left out. In a simulation the process may be the emulator's own, with its trace."""
    keep_payloads: Switch = False
    """Keep the payloads of all frames in `payloads.parquet`; until the end of the run they are in memory."""
    control_hz: float = Field(10.0, ge=10, le=100)
    """Control instants a second of vehicles that programs drive: a whole multiple of `world.gnss.rate_hz`, at
    intervals of whole nanoseconds, as 20, 25, 40, 50 or 100 with 10."""

    @model_validator(mode="after")
    def _orders_are_of_lockstep(self) -> Run:
        if self.order != "fifo" and self.pacing != "lockstep":
            raise ValueError(
                f'order = "{self.order}" goes with pacing = "lockstep": in real time nobody decides it'
            )
        if self.order_slack_us and self.pacing != "lockstep":
            raise ValueError('order_slack_us goes with pacing = "lockstep": in real time nobody decides the order')
        if self.tape is not None and (self.order != "fifo" or self.pacing != "lockstep"):
            raise ValueError('tape goes with order = "fifo" and pacing = "lockstep"')
        return self

    @property
    def order_grid(self) -> Grid:
        """The instants at which vehicles are shown packets and timers, if there is a slack."""
        return Grid(self.order_slack_us * 1_000, self.order_seed % 4 * self.order_slack_us * 250)


class Radio(Section):
    """`[radio]`: what stands between one vehicle's broadcast and another's reception.

    The subsections make it a physical radio, stage by stage; docs/radio.md says what each of them does.
    """

    range_m: float = Field(3000.0, gt=0, le=FAR_M)
    """Range of the disc: all vehicles within it hear each other, unless there are `links` or a `path_loss`."""
    links: Path | tuple[tuple[int, ...], ...] | None = None
    """Links in place of the range: a square matrix of 0 and 1, or a CSV file of one without a header (relative to
    the scenario file). Row i, column j is 1 where vehicle i hears vehicle j, in the order of the network's
    vehicles; the diagonal is ignored. Or a CSV file of links over time with the columns time_s, sender, receiver,
    loss, sorted by time: the loss probability of a link until its next row; without a loss, and before its first
    row, the receiver is out of range."""
    max_peers: int = Field(30, ge=1, le=MANY)
    """Peer cap: each receiver hears at most so many senders, the nearest that are up."""
    loss: float = Field(0.0, ge=0, le=1)
    """Probability that a frame is lost, independently at each receiver."""
    latency_ms: float = Field(2.0, ge=0.001, le=1000 * DAY_S)
    """Least time from the end of the transmission to the arrival."""
    jitter_ms: float = Field(1.0, ge=0, le=1000 * DAY_S)
    """Jitter of the latency: uniform from 0, drawn for each receiver; by default 0 with `program.kind = "zenoh"`,
    as Zenoh keeps the order of what one program puts."""
    access_jitter_ms: float = Field(1.0, ge=0, le=1000 * DAY_S)
    """Random wait before the transmission: uniform from 0, drawn for each frame."""
    delivery_tick_us: int = Field(0, ge=0, le=MANY)
    """Arrivals are rounded up to a multiple of it, before faults delay them; 0 means no rounding."""
    max_payload_bytes: int = Field(1400, ge=1, le=65_000)
    """A longer payload is refused."""
    bitrate_mbps: float = Field(6.0, ge=1e-6)
    """A frame takes its payload's bits over this to send; each sender sends one at a time. With a path loss or a
    medium it is one of 802.11p's (3, 4.5, 6, 9, 12, 18, 24 or 27), and frames take as long as there."""
    queue_frames: int = Field(64, ge=1, le=MANY)
    """Frames that may wait at a sender; further ones are dropped (`queue_full`)."""
    path_loss: PathLoss | None = None
    """Path loss; it replaces the range: received power decides connectivity."""
    shadowing: Shadowing | None = None
    """Shadowing by obstacles, which differs between links."""
    buildings: Buildings | None = None
    """Attenuation by buildings, those of the map or of a file."""
    fading: Fading | None = None
    """Fading: variation of the power from frame to frame."""
    receiver: Receiver | None = None
    """Noise and detection thresholds; the defaults hold wherever a path loss is configured."""
    mac: Mac | None = None
    """All share one medium: carrier sensing, or a grid of reserved resources; without it nobody is in anybody's
    way."""
    congestion: Congestion | None = None
    """Senders send less where the medium is busy."""
    keys: tuple[str, ...] | None = None
    """For programs of `kind = "zenoh"`: key expressions that cross the radio, none of which overlap; `**` and
    `**/@adv/**` if left out, none if empty. What is put elsewhere stays in its vehicle, and so does `vnet/**`."""

    profile: Literal["ros2"] | None = None
    """For programs of `kind = "zenoh"`: what their keys mean. With `ros2` topics and services of rmw_zenoh, and the
    tokens of its graph, cross the radio, except those that stay inside (docs/how-to/ros2.md)."""
    ros2: Ros2Topics | None = None
    """Its options; it has its defaults if left out."""

    @property
    def is_physical(self) -> bool:
        """True if signals have a power, and frames the airtime of 802.11p or of a sidelink."""
        return self.path_loss is not None or self.mac is not None

    @property
    def sidelink(self) -> Sidelink | None:
        """The MAC, if it is a grid of resources."""
        return self.mac if isinstance(self.mac, Sidelink) else None

    @model_validator(mode="before")
    @classmethod
    def _mac_has_a_kind(cls, data: Any) -> Any:
        """Fill in 802.11p."""
        if not isinstance(data, dict) or not isinstance(mac := data.get("mac"), dict):
            return data
        return {**data, "mac": {"kind": Edca.model_fields["kind"].default, **mac}}

    @model_validator(mode="after")
    def _sections_fit_the_mac(self) -> Radio:
        mac, receiver = self.sidelink, self.receiver
        if mac is None:
            if isinstance(self.congestion, CrLimit):
                raise ValueError('congestion.kind = "cr_limit" goes with a MAC of kind "lte-mode4" or "nr-mode2"')
            return self
        carried = mac.subchannels * mac.subchannel_bytes
        if "max_payload_bytes" not in self.model_fields_set:  # nor is it then: it follows from the MAC
            self.__dict__["max_payload_bytes"] = min(self.max_payload_bytes, carried)
        if self.max_payload_bytes > carried:
            raise ValueError(
                f"max_payload_bytes = {self.max_payload_bytes}: a slot of {mac.subchannels} subchannels carries at "
                f"most {carried}"
            )
        if self.congestion is not None and not isinstance(self.congestion, CrLimit):
            raise ValueError(f'congestion.kind = "{self.congestion.kind}" goes with mac.kind = "80211p"')
        for name in ("min_snr_db", "min_rssi_dbm"):
            if receiver is not None and getattr(receiver, name) != Receiver.model_fields[name].default:
                raise ValueError(
                    f'receiver.{name} goes with mac.kind = "80211p"; others have mac.sensing_dbm and bler'
                )
        if self.bitrate_mbps != type(self).model_fields["bitrate_mbps"].default:
            raise ValueError('bitrate_mbps goes with mac.kind = "80211p"; others have mac.subchannel_bytes')
        return self

    @model_validator(mode="after")
    def _stages_fit_together(self) -> Radio:
        if self.path_loss is not None and self.links is not None:
            raise ValueError("path_loss and links both say who hears whom: leave one of them out")
        for name in ("shadowing", "buildings", "fading"):
            if getattr(self, name) is not None and self.path_loss is None:
                raise ValueError(f"{name} needs path_loss: without it no signal is weaker than another")
        if self.receiver is not None and not self.is_physical:
            raise ValueError("receiver needs path_loss or mac: without them there is no signal and no interference")
        if self.congestion is not None and self.mac is None:
            raise ValueError("congestion needs mac: without it nobody senses how busy the channel is")
        if self.is_physical and self.bitrate_mbps not in RATES_MBPS:
            rates = ", ".join(f"{rate:g}" for rate in RATES_MBPS)
            raise ValueError(f"bitrate_mbps = {self.bitrate_mbps:g}: 802.11p has {rates}")
        return self

    @model_validator(mode="before")
    @classmethod
    def _ros2_is_of_its_profile(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        if data.get("profile") == "ros2":
            return {"ros2": {}, **data}
        if data.get("ros2") is not None:
            raise ValueError('ros2 goes with profile = "ros2"')
        return data

    @field_validator("keys")
    @classmethod
    def _keys_are_expressions(cls, keys: tuple[str, ...] | None) -> tuple[str, ...] | None:
        from vnet.gateway.keys import check_keys  # with Zenoh, which is slow to import

        try:
            check_keys(keys or ())
        except ProgramError as error:
            raise ValueError(str(error)) from None
        return keys

    @field_validator("links", mode="before")
    @classmethod
    def _links_are_a_file_or_a_matrix(cls, links: Any) -> Any:
        if links is None or isinstance(links, (str, Path)):
            return links
        if not isinstance(links, (list, tuple)) or not links:
            raise ValueError("write the name of a CSV file, or a square matrix of 0 and 1")
        for number, row in enumerate(links, start=1):
            if not isinstance(row, (list, tuple)) or len(row) != len(links):
                raise ValueError(f"not square: row {number} of {len(links)} should be {len(links)} entries long")
            for entry in row:
                if type(entry) is not int or entry not in (0, 1):
                    raise ValueError(f"row {number} holds {shown(entry)}: each entry should be 0 or 1")
        return links


class Scenario(Section):
    """A whole scenario. All sections have defaults, so that an empty file is a valid run."""

    run: Run = Run()
    network: Network = Network()
    map: Map | None = None
    """The roads on which vehicles drive, if programs are to know them."""
    world: WorldSection = WorldSection()
    radio: Radio = Radio()
    roadside: tuple[RoadsideUnit, ...] = ()
    """Roadside units: nodes that stand beside the road."""
    backbone: Backbone | None = None
    """The wired network among them; it has its defaults if left out."""
    program: Program = Program()
    fault: tuple[AnyFault, ...] = ()
    """The faults, and when they act."""

    @field_validator("roadside")
    @classmethod
    def _units_have_names(cls, units: tuple[RoadsideUnit, ...]) -> tuple[RoadsideUnit, ...]:
        return with_names(units)

    @model_validator(mode="before")
    @classmethod
    def _zenoh_keeps_its_order(cls, data: Any) -> Any:
        """Fill in no jitter for Zenoh programs: Zenoh delivers what one of them puts in the order of putting."""
        if not isinstance(data, dict) or not isinstance(radio := data.get("radio", {}), dict):
            return data
        program = data.get("program")
        kind = program.get("kind") if isinstance(program, dict) else getattr(program, "kind", None)
        return {**data, "radio": {"jitter_ms": 0.0, **radio}} if kind == "zenoh" else data

    @model_validator(mode="after")
    def _faults_start_in_time(self) -> Scenario:
        for number, fault in enumerate(self.fault):
            if fault.at_s >= self.healed_s:
                raise ValueError(
                    f"fault.{number}.at_s = {fault.at_s:g}: must be less than {self.healed_s:g}, which is "
                    "run.duration_s - run.settle_s"
                )
        return self

    @model_validator(mode="after")
    def _zenoh_programs_can_run(self) -> Scenario:
        if self.program.kind != "zenoh":
            for name in ("keys", "profile"):
                if getattr(self.radio, name) is not None:
                    raise ValueError(f'radio.{name} goes with program.kind = "zenoh"')
            return self
        for unit in self.roadside:
            if unit.entry is not None:
                raise ValueError(f'roadside.entry = {shown(unit.entry)} goes with program.kind = "vnet"')
        for number, fault in enumerate(self.fault):
            if why := self.refusal_of(fault):
                raise ValueError(f'fault.{number}.kind = "{fault.kind}" {why}')
        if self.run.pacing == "lockstep":
            if not self.program.commands or any(each.command is None for each in self.program.exceptions):
                raise ValueError('program.kind = "zenoh", and each exception, need a command in lockstep')
            for words in self.program.all_commands:
                if not PYTHON_NAME.fullmatch(Path(words[0]).name) or not python_words(words):
                    raise ValueError(
                        f"program.command = {shown(shlex.join(words))}: in lockstep a command is python SCRIPT …, "
                        "python -m MODULE … or python -c CODE …, perhaps with "
                        f'{" ".join(sorted(PYTHON_FLAGS))}; any other needs run.pacing = "realtime"'
                    )
            if self.radio.ros2 is not None and self.radio.ros2.graph == "always":
                raise ValueError('radio.ros2.graph = "always" needs run.pacing = "realtime"')
            return self
        if self.run.nodes_per_process != 1:
            raise ValueError('run.nodes_per_process goes with program.kind = "vnet": Zenoh programs have their own')
        return self

    def refusal_of(self, fault: Fault) -> str | None:
        """Return why a fault of this kind cannot act on the run's programs, None if it can."""
        pacing, is_zenoh = self.run.pacing, self.program.kind == "zenoh"
        if is_zenoh and pacing == "realtime" and fault.kind in ("skew", "drift"):
            return 'needs run.pacing = "lockstep": in real time nothing changes the clock of a Zenoh program'
        if is_zenoh and pacing == "lockstep" and fault.kind == "router_restart":
            return 'needs run.pacing = "realtime": in lockstep a Zenoh program has no router'
        return None

    @model_validator(mode="after")
    def _slack_divides_the_period(self) -> Scenario:
        slack_us = self.run.order_slack_us
        if slack_us and self.period_ns % (slack_us * 1_000):
            raise ValueError(
                f"run.order_slack_us = {slack_us}: must divide the period of fixes, {self.period_ns / 1_000:g} µs"
            )
        return self

    @model_validator(mode="after")
    def _roads_are_for_those_who_drive(self) -> Scenario:
        kind = self.network.kind
        if self.map is not None and not self.network.moves:
            raise ValueError(f'map goes with vehicles that drive on it, not with network.kind = "{kind}"')
        if self.map is not None and kind == "driven" and self.driven.road != "map":
            raise ValueError(f'map goes with network.driven.road = "map", not with "{self.driven.road}"')
        if kind == "driven":
            check_driving(self.driven, self.run.control_hz, self.period_ns, self.world)
        elif self.network.step:
            check_stepped_sumo(self.run.control_hz, self.period_ns, self.world)
        elif self.world.ranging is not None:
            raise ValueError(f'world.ranging goes with network.kind = "driven" or network.step, not with "{kind}"')
        return self

    @model_validator(mode="after")
    def _powers_of_units_are_modelled(self) -> Scenario:
        powers = [number for number, unit in enumerate(self.roadside) if unit.tx_power_dbm is not None]
        if powers and self.radio.path_loss is None:
            raise ValueError(
                f"roadside.{powers[0]}.tx_power_dbm goes with radio.path_loss: without it no radio has a power"
            )
        return self

    @model_validator(mode="after")
    def _buildings_are_in_a_file(self) -> Scenario:
        buildings = self.radio.buildings
        if buildings is not None and buildings.path is None and self.map is None:
            raise ValueError("radio.buildings.path is missing: without [map] there is no other file of buildings")
        return self

    @property
    def has_gateways(self) -> bool:
        """True if programs speak Zenoh to gateways, and not as agents to the emulator."""
        return self.program.kind == "zenoh" and self.run.pacing == "realtime"

    def require_extras(self) -> None:
        """Raise ScenarioError in one line where what the scenario needs is in an extra that is not installed."""
        if self.radio.is_physical:
            require("a physical radio (radio.path_loss, radio.mac)", "scipy", error=ScenarioError)
        if self.network.kind == "city":
            require("a generated city", "scipy", error=ScenarioError)
        if self.network.step:
            require("network.step = true", LIBSUMO, error=ScenarioError)
        if self.map is not None and self.map.path.suffix in OSM_ENDINGS:
            require(f"{self.map.path}: a file of OpenStreetMap", "osmium", "pyproj", error=ScenarioError)

    def options_of(self, node: str) -> dict[str, Any]:
        """Return the options of a node's program: those of the scenario, or what a Zenoh program is run with."""
        if self.program.kind != "zenoh":
            return self.program.of(node).options
        sessions = self.program.sessions
        own: dict[str, Any] = {
            "command": self.program.commands_of(node),
            "environment": self.program.of(node).environment,
            "query_s": sessions.query_s,
            "liveliness_s": sessions.liveliness_s,
            "queue_frames": self.radio.queue_frames,
        }
        if self.radio.ros2 is not None:
            own["ros2"] = self.radio.ros2.model_dump(mode="json", exclude={"graph"})
        return own | ({} if self.radio.keys is None else {"keys": list(self.radio.keys)})

    @property
    def driven(self) -> Driven:
        """Road and dynamics of driven vehicles."""
        return self.network.driven or Driven()

    @property
    def unit_ids(self) -> tuple[str, ...]:
        """Ids of the roadside units."""
        return tuple(unit.name for unit in self.roadside)

    @property
    def healed_s(self) -> float:
        """Time at which all faults have healed, in emulated seconds."""
        return self.run.duration_s - self.run.settle_s

    @property
    def duration_ns(self) -> int:
        """Length of the run in nanoseconds."""
        return round(self.run.duration_s * NS_PER_S)

    @property
    def world_ns(self) -> int:
        """Length in nanoseconds for which the world is made."""
        return max(self.duration_ns, round((self.run.world_s or 0.0) * NS_PER_S))

    @property
    def period_ns(self) -> int:
        """Time between two GNSS fixes in nanoseconds: the period in which programs are thought to work."""
        return round(NS_PER_S / self.world.gnss.rate_hz)


MIN_LATENCY_NS = 1_000
"""Least latency of a reception: time passes in every exchange between nodes."""


def least_latency_ns(radio: Radio) -> int:
    """Return the shortest time from the end of a frame to its arrival: faults and jitter only add to it."""
    return max(int(radio.latency_ms * NS_PER_MS), MIN_LATENCY_NS)


def least_transit_ns(radio: Radio) -> int:
    """Return the shortest time from sending to arrival: on a sidelink a frame waits for `t1_slots` at least."""
    mac = radio.sidelink
    return least_latency_ns(radio) + (0 if mac is None else mac.t1_slots * mac.slot_ns)


def lookahead_ns(scenario: Scenario) -> int:
    """Return the shortest time from sending to arrival: of frames, and of messages among roadside units."""
    radio_ns = least_transit_ns(scenario.radio)
    if len(scenario.roadside) < 2:
        return radio_ns
    backbone = scenario.backbone or Backbone()
    return min(radio_ns, max(int(backbone.latency_ms * NS_PER_MS), MIN_LATENCY_NS))
