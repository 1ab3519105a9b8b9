"""The sections of a physical radio: `[radio.path_loss]`, `shadowing`, `buildings`, `fading`, `receiver`, `mac`, …

Each section adds a stage to the channel: without any of them the radio is the disc of
`radio.range_m`. docs/radio.md has the formulas and where the defaults come from.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field, model_validator

from emulator.scenario.network import OriginDeg
from emulator.scenario.sections import Section, Switch, must_grow
from emulator.scenario.sidelink import CrLimit, LteMode4, NrMode2

RATES_MBPS = (3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0, 27.0)
"""The bit rates of 802.11p in 10 MHz (802.11-2020, table 17-4)."""


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
            raise ValueError(f"{len(self.m)} shapes m need {len(self.m) - 1} distances until_m between them")
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
