"""The sections of a physical radio: `[radio.path_loss]`, `shadowing`, `buildings`, `fading`, `receiver`, `mac`, …

Each section adds a stage to the channel: without any of them the radio is the disc of
`radio.range_m`. docs/radio.md has the formulas and where the defaults come from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from emulator.scenario.network import OriginDeg
from emulator.scenario.sections import Section, Switch, must_grow, must_not_grow
from vnet.errors import counted
from vnet.units import NS_PER_MS

QPSK_07_SINR_DB = (0.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 16.0, 20.0, 20.001)
"""SINR in dB of `QPSK_07_BLER`."""
QPSK_07_BLER = (1.0, 0.9, 0.7, 0.4, 0.13, 0.045, 0.017, 0.007, 1e-3, 1e-3, 1e-4)
"""Block error rates of 190 bytes at QPSK 0.7 and 280 km/h (3GPP R1-160284, from Gonzalez-Martin et al. 2019)."""
LONG_PERIODS_MS = tuple(range(100, 1001, 100))
"""Reservation intervals of both standards from 100 ms on."""
MOST_SUBCHANNELS = 27
"""Most subchannels of a carrier (3GPP TS 38.331)."""

Db = Annotated[float, Field(ge=-100, le=200)]
RATES_MBPS = (3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0, 27.0)
"""The bit rates of 802.11p in 10 MHz (802.11-2020, table 17-4)."""


class Sidelink(Section):
    """A grid of slots and subchannels, in which every vehicle reserves its resources by what it has sensed."""

    periods_ms: ClassVar[tuple[int, ...]] = LONG_PERIODS_MS
    """Reservation intervals that the standard has."""
    ranks_power: ClassVar[bool] = True
    """True if the quietest of the candidates are taken, and not any of them."""

    subchannels: int = Field(4, ge=1, le=MOST_SUBCHANNELS)
    """Subchannels, side by side in frequency."""
    subchannel_bytes: int = Field(190, ge=1, le=65_000)
    """Bytes that one subchannel carries in a slot; a longer frame takes several."""
    data_blocks: int = Field(10, ge=1, le=275)
    """Resource blocks of data in a subchannel: the bandwidth of the noise."""
    sensing_dbm: float = Field(-90.5, ge=-300, le=100)
    """Least received power at which a frame is detected (`below_sensing`)."""
    exclusion_dbm: float = Field(-110.0, ge=-300, le=100)
    """Received power from which a reserved resource is excluded, before it is raised in steps of 3 dB."""
    keep_probability: float = Field(0.0, ge=0, le=0.8)
    """Probability of keeping a resource as its counter ends."""
    reservation_ms: int = 100
    """Reservation interval until a sender's period is told, or learned from its frames.

    The standards have 100, 200, … 1000 ms; mode 4 also 20 and 50 ms, mode 2 also 1 to 99 ms.
    """
    t1_slots: int = Field(4, ge=1)
    """Slots from a frame to its selection window: at most 4; in mode 2 at 30 and 60 kHz at most 5 and 9.

    In mode 2 at 15 kHz the standard has at most 3 (TS 38.214, table 8.1.4-2).
    """
    t2_ms: int = Field(100, ge=10, le=100)
    """End of the selection window, and the delay beyond which a frame gets a resource of its own."""
    retransmit: Switch = False
    """True if each frame is transmitted twice within 16 slots, wherever candidates for that are left."""
    in_band_emission_db: float = Field(30.0, ge=0, le=300)
    """Attenuation of a signal in the subchannels that it does not use."""
    busy_dbm: float = Field(-94.0, ge=-300, le=100)
    """Received power from which a subchannel is busy; with less it counts as silent where candidates are ranked."""
    bler_sinr_db: tuple[Db, ...] = QPSK_07_SINR_DB
    """Ratios of signal to noise and interference at which `bler` is given, increasing."""
    bler: tuple[Annotated[float, Field(ge=0, le=1)], ...] = QPSK_07_BLER
    """Block error rates at them, linear in between; below the first and above the last they stay as there."""

    @property
    def slot_ns(self) -> int:
        """Length of a slot in nanoseconds."""
        return NS_PER_MS

    @property
    def sensing_slots(self) -> int:
        """Length of the sensing window in slots."""
        return 1000

    @property
    def block_khz(self) -> int:
        """Width of a resource block."""
        return 180

    @property
    def most_t1(self) -> int:
        """The largest `t1_slots`."""
        return 4

    @property
    def most_blocks(self) -> int:
        """Resource blocks of the widest carrier (TS 36.101, TS 38.101-1)."""
        return 100

    @property
    def candidate_share(self) -> float:
        """The share of resources that must remain as candidates."""
        return 0.2

    @property
    def projected_ms(self) -> int:
        """The time over which reservations with shorter intervals are repeated (TS 36.213, 14.1.1.6)."""
        return 100

    def counters(self, period_ms: int) -> tuple[int, int]:
        """Return the least and the largest value of a new reselection counter (TS 36.321, TS 38.321)."""
        times = -(-100 // max(20, min(period_ms, 100)))
        return 5 * times, 15 * times

    @model_validator(mode="after")
    def _fits_the_standard(self) -> Sidelink:
        if self.reservation_ms not in self.periods_ms:
            raise ValueError(f"reservation_ms = {self.reservation_ms}: {allowed_periods(self.periods_ms)}")
        if self.t1_slots > self.most_t1:
            raise ValueError(f"t1_slots = {self.t1_slots}: must be less than or equal to {self.most_t1}")
        if self.t1_slots * self.slot_ns >= self.t2_ms * NS_PER_MS:
            raise ValueError(f"t2_ms = {self.t2_ms}: must be later than t1_slots = {self.t1_slots}")
        if len(self.bler) != len(self.bler_sinr_db) or not self.bler:
            raise ValueError(
                f"bler has {len(self.bler)} values, bler_sinr_db {len(self.bler_sinr_db)}: need as many, at least 1"
            )
        must_grow("bler_sinr_db", self.bler_sinr_db)
        must_not_grow("bler", self.bler)
        if (blocks := self.subchannels * self.data_blocks) > self.most_blocks:
            raise ValueError(
                f"subchannels = {self.subchannels}: with data_blocks = {self.data_blocks} these are {blocks} "
                f"resource blocks; at most {self.most_blocks} are allowed"
            )
        return self


class LteMode4(Sidelink):
    """LTE-V2X mode 4 (3GPP release 14): subframes of 1 ms, semi-persistent reservations, ranking by power."""

    periods_ms: ClassVar[tuple[int, ...]] = (20, 50, *LONG_PERIODS_MS)

    kind: Literal["lte-mode4"]
    """This MAC."""
    one_shot: Switch = False
    """True if every second to sixth frame is sent on a resource of its own, once (SAE J3161/1)."""


class NrMode2(Sidelink):
    """NR-V2X mode 2 (3GPP release 16): slots of 1, 0.5 or 0.25 ms, without feedback channel."""

    periods_ms: ClassVar[tuple[int, ...]] = (*range(1, 100), *LONG_PERIODS_MS)
    ranks_power: ClassVar[bool] = False

    kind: Literal["nr-mode2"]
    """This MAC."""
    scs_khz: Literal[15, 30, 60] = 30
    """Subcarrier spacing: slots of 1, 0.5 and 0.25 ms."""
    sensing_ms: Literal[100, 1100] = 1100
    """Length of the sensing window."""
    share_percent: Literal[20, 35, 50] = 20
    """Percentage of the resources that must remain as candidates."""
    scheduling: Literal["sps", "dynamic"] = "sps"
    """`sps` reserves a resource for the frames to come; `dynamic` selects one for each frame."""
    re_evaluation: Switch = True
    """True if new resources are checked once more, `t1_slots` before they are used, and replaced if taken."""

    @property
    def slot_ns(self) -> int:
        """Length of a slot in nanoseconds."""
        return NS_PER_MS * 15 // self.scs_khz

    @property
    def sensing_slots(self) -> int:
        """Length of the sensing window in slots."""
        return self.sensing_ms * NS_PER_MS // self.slot_ns

    @property
    def block_khz(self) -> int:
        """Width of a resource block."""
        return 12 * self.scs_khz

    @property
    def most_t1(self) -> int:
        """The largest `t1_slots` (TS 38.214, table 8.1.4-2, which has 3 at 15 kHz)."""
        return {15: 4, 30: 5, 60: 9}[self.scs_khz]

    @property
    def most_blocks(self) -> int:
        """Resource blocks of the widest carrier (TS 38.101-1, table 5.3.2-1)."""
        return {15: 270, 30: 273, 60: 135}[self.scs_khz]

    @property
    def candidate_share(self) -> float:
        """The share of resources that must remain as candidates."""
        return self.share_percent / 100

    @property
    def projected_ms(self) -> int:
        """The time over which reservations with shorter intervals are repeated (T_scal of TS 38.214, 8.1.4)."""
        return self.t2_ms


class CrLimit(Section):
    """Congestion control of a sidelink: the busier the channel, the smaller a sender's share of its resources.

    The limits are set by regions and priorities (for Europe ETSI TS 103 574), so none is a default.
    """

    kind: Literal["cr_limit"]
    """This control."""
    busy: tuple[Annotated[float, Field(ge=0, lt=1)], ...] = Field(min_length=1)
    """Channel busy ratios from which the limits hold, increasing."""
    most: tuple[Annotated[float, Field(gt=0, le=1)], ...]
    """Largest channel occupancy ratio of a sender over 1000 ms; a frame beyond it is `no_grant`."""

    @model_validator(mode="after")
    def _a_limit_for_each_busy_ratio(self) -> CrLimit:
        if len(self.busy) != len(self.most):
            raise ValueError(f"{len(self.busy)} busy ratios need as many limits most, not {len(self.most)}")
        must_grow("busy", self.busy)
        must_not_grow("most", self.most)
        return self


def allowed_periods(periods_ms: tuple[int, ...]) -> str:
    """Return the reservation intervals of a MAC in words."""
    short = [str(each) for each in periods_ms if each < 100]
    text = "1 to 99" if len(short) > 2 else ", ".join(short)
    return f"allowed are {text}{' and ' if len(short) > 2 else ', '}{', '.join(map(str, LONG_PERIODS_MS))} ms"


class _PathLoss(Section):
    """The keys of every path loss."""

    tx_power_dbm: float = Field(20.0, ge=-100, le=100)
    """Transmit power of every vehicle, antenna gains included."""
    floor_dbm: float = Field(-94.0, ge=-300, le=100)
    """Receptions with less mean power (with shadowing, without fading) are out of range."""


class FreeSpace(_PathLoss):
    """Friis: 20 log10(4π d / λ) dB."""

    kind: Literal["free_space"]
    """This model."""
    frequency_ghz: float = Field(5.9, ge=0.1, le=100)
    """Carrier frequency."""


class LogDistance(_PathLoss):
    """`reference_db` at one metre, and 10 · `exponent` · log10(d / 1 m) dB beyond it."""

    kind: Literal["log_distance"]
    """This model."""
    exponent: float = Field(2.0, gt=0, le=10)
    """Path loss exponent."""
    reference_db: float = Field(47.86, ge=0, le=300)
    """Path loss at a distance of one metre."""


class DualSlope(_PathLoss):
    """Path loss as `log_distance` up to `break_m`, and with `far_exponent` beyond it."""

    kind: Literal["dual_slope"]
    """This model."""
    exponent: float = Field(2.1, gt=0, le=10)
    """Path loss exponent up to `break_m`."""
    far_exponent: float = Field(3.8, gt=0, le=10)
    """Path loss exponent beyond it."""
    break_m: float = Field(100.0, ge=1, le=1e6)
    """Breakpoint distance, at which the exponent changes."""
    reference_db: float = Field(47.86, ge=0, le=300)
    """Path loss at a distance of one metre."""


class TwoRay(_PathLoss):
    """Two-ray interference: the direct ray and the one that the ground reflects."""

    kind: Literal["two_ray"]
    """This model."""
    frequency_ghz: float = Field(5.9, ge=0.1, le=100)
    """Carrier frequency."""
    antenna_m: float = Field(1.5, gt=0, le=1000)
    """Height of both antennas above the ground."""
    permittivity: float = Field(1.02, gt=1, le=1000)
    """Relative permittivity of the ground."""


class WinnerB1(_PathLoss):
    """WINNER+ B1 with line of sight, at least free space: 3GPP's urban model for vehicles (TR 36.885)."""

    kind: Literal["winner_b1"]
    """This model."""
    frequency_ghz: float = Field(5.9, ge=0.1, le=100)
    """Carrier frequency."""
    antenna_m: float = Field(1.5, gt=0, le=1000)
    """Height of both antennas above the ground."""
    environment_m: float = Field(0.0, ge=0, le=100)
    """Effective height of the environment, less than that of the antennas."""

    @model_validator(mode="after")
    def _antennas_are_above_it(self) -> WinnerB1:
        if self.environment_m >= self.antenna_m:
            raise ValueError(f"environment_m = {self.environment_m:g}: must be less than antenna_m")
        return self


PathLoss = Annotated[FreeSpace | LogDistance | DualSlope | TwoRay | WinnerB1, Field(discriminator="kind")]


class Shadowing(Section):
    """`[radio.shadowing]`: log-normal, symmetric, and correlated between links with nearby ends."""

    sigma_db: float = Field(3.0, ge=0, le=50)
    """Standard deviation of the shadowing."""
    decorrelation_m: float = Field(25.0, gt=0, le=1e6)
    """Displacement of one end at which the correlation has fallen to 1/e."""


class Buildings(Section):
    """`[radio.buildings]`: attenuation by the buildings between two vehicles (Sommer, Eckhoff, German and Dressler
    2011): `wall_db` for each outer wall on the straight way, and `inside_db_per_m` for each metre inside."""

    path: Path | None = None
    """Outlines, relative to the scenario file: OpenStreetMap's XML or PBF, GeoJSON, SUMO's `.poly.xml`, or CSV in
    metres with the columns building, x_m, y_m, a row for each corner. Those of the file of `[map]` if left out."""
    origin_deg: OriginDeg | None = None
    """Latitude and longitude of x = y = 0 m, if the file is in degrees, and neither map nor trips say it."""
    wall_db: float = Field(9.0, ge=0, le=300)
    """Attenuation by each outer wall."""
    inside_db_per_m: float = Field(0.4, ge=0, le=300)
    """Attenuation by each metre inside a building."""


class Fading(Section):
    """`[radio.fading]`: Nakagami, drawn for each frame and receiver."""

    m: tuple[Annotated[float, Field(ge=0.5, le=100)], ...] = (1.5, 0.75)
    """Shape parameters up to each of the distances `until_m`, and beyond the last; 1 is Rayleigh fading."""
    until_m: tuple[Annotated[float, Field(gt=0, le=1e9)], ...] = (80.0,)
    """Distances at which the shape changes, increasing."""

    @model_validator(mode="after")
    def _a_shape_for_each_stretch(self) -> Fading:
        if len(self.m) != len(self.until_m) + 1:
            raise ValueError(
                f"m has {counted(len(self.m), 'shape')}, and until_m {counted(len(self.until_m), 'distance')}: "
                "one shape more than distances is needed"
            )
        must_grow("until_m", self.until_m)
        return self


class Receiver(Section):
    """`[radio.receiver]`: noise and detection thresholds. The defaults hold wherever a path loss is configured."""

    noise_dbm: float = Field(-104.0, ge=-300, le=100)
    """Thermal noise in 10 MHz."""
    noise_figure_db: float = Field(7.0, ge=0, le=100)
    """Noise figure of the receiver, added to the thermal noise."""
    min_snr_db: float = Field(4.0, ge=-50, le=100)
    """Least ratio of signal to noise and interference at which a frame is detected."""
    min_rssi_dbm: float = Field(-82.0, ge=-300, le=100)
    """Least received power at which a frame is detected."""


class Edca(Section):
    """A shared medium with carrier sensing: EDCA of 802.11p. It is the kind where none is given."""

    kind: Literal["80211p"] = "80211p"
    """This MAC."""
    access_category: Literal["VO", "VI", "BE", "BK"] = "BE"
    """Access category of EDCA; it sets the interframe space and the contention window."""
    carrier_sense_dbm: float = Field(-85.0, ge=-300, le=100)
    """Total received power from which the medium is busy."""
    eifs: Switch = False
    """True if vehicles wait for EIFS also after broadcasts that they could not decode."""


Mac = Annotated[Edca | LteMode4 | NrMode2, Field(discriminator="kind")]
"""`[radio.mac]`: the vehicles share one medium."""


class EtsiReactive(Section):
    """The reactive table of ETSI TS 102 687. Every 100 ms a sender moves one state up or down, towards
    that of its channel busy ratio."""

    kind: Literal["etsi"]
    """This control."""
    busy: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = (0.3, 0.4, 0.5, 0.65)
    """Channel busy ratios at which the second state begins, the third, …"""
    pause_ms: tuple[Annotated[float, Field(ge=0, le=60_000)], ...] = (50.0, 100.0, 200.0, 250.0, 1000.0)
    """Least time between two frames of a sender, by state."""
    waiting: int = Field(1, ge=1, le=1_000_000)
    """Frames that may wait; a newer frame replaces the oldest one (`held_back`)."""

    @model_validator(mode="after")
    def _a_pause_for_each_state(self) -> EtsiReactive:
        if len(self.pause_ms) != len(self.busy) + 1:
            raise ValueError(f"{len(self.pause_ms)} pauses need {len(self.pause_ms) - 1} busy ratios between them")
        must_grow("busy", self.busy)
        return self


class Limeric(Section):
    """LIMERIC, the adaptive approach of ETSI TS 102 687. Every 200 ms a sender's duty cycle becomes
    (1 - `alpha`) duty cycle + `beta` (`target` - channel busy ratio)."""

    kind: Literal["limeric"]
    """This control."""
    alpha: float = Field(0.016, gt=0, lt=1)
    """Forgetting factor of the duty cycle."""
    beta: float = Field(0.0012, gt=0, lt=1)
    """Gain of the difference from the target."""
    target: float = Field(0.68, gt=0, lt=1)
    """Target channel busy ratio."""
    most_up: float = Field(0.0005, gt=0, lt=1)
    """Largest increase of the duty cycle in one step, on a free medium."""
    most_down: float = Field(0.00025, gt=0, lt=1)
    """Largest decrease of the duty cycle in one step, on a busy medium."""
    least: float = Field(0.0006, gt=0, lt=1)
    """The smallest share."""
    most: float = Field(0.03, gt=0, le=1)
    """The largest share."""
    waiting: int = Field(1, ge=1, le=1_000_000)
    """Frames that may wait; a newer frame replaces the oldest one (`held_back`)."""


Congestion = Annotated[EtsiReactive | Limeric | CrLimit, Field(discriminator="kind")]
