"""The sections of a physical radio: `[radio.path_loss]`, `shadowing`, `fading`, `receiver`, `mac`, `congestion`.

Each is a stage of the channel, and left out it is no stage: without any of them the radio is the disc of
`radio.range_m`. docs/radio.md has the formulas and where the defaults come from.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Literal

from pydantic import Field, model_validator

from vnet.sections import Section

RATES_MBPS = (3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0, 27.0)
"""The bit rates of 802.11p in 10 MHz (802.11-2020, table 17-4)."""


class _PathLoss(Section):
    """What all path losses have. Pairs whose mean power is below `floor_dbm` are out of range."""

    tx_power_dbm: float = Field(20.0, ge=-100, le=100)
    floor_dbm: float = Field(-94.0, ge=-300, le=100)


class FreeSpace(_PathLoss):
    """Friis: 20 log10(4π d / λ) dB."""

    kind: Literal["free_space"]
    frequency_ghz: float = Field(5.9, ge=0.1, le=100)


class LogDistance(_PathLoss):
    """`reference_db` at one metre and 10 · `exponent` · log10(d / 1 m) beyond it."""

    kind: Literal["log_distance"]
    exponent: float = Field(2.0, gt=0, le=10)
    reference_db: float = Field(47.86, ge=0, le=300)


class DualSlope(_PathLoss):
    """As `log_distance` up to `break_m`, and with `far_exponent` beyond it."""

    kind: Literal["dual_slope"]
    exponent: float = Field(2.1, gt=0, le=10)
    far_exponent: float = Field(3.8, gt=0, le=10)
    break_m: float = Field(100.0, ge=1, le=1e6)
    reference_db: float = Field(47.86, ge=0, le=300)


class TwoRay(_PathLoss):
    """Two-ray interference: the direct ray and the one that the ground reflects, both ends `antenna_m` above it."""

    kind: Literal["two_ray"]
    frequency_ghz: float = Field(5.9, ge=0.1, le=100)
    antenna_m: float = Field(1.5, gt=0, le=1000)
    permittivity: float = Field(1.02, gt=1, le=1000)


PathLoss = Annotated[FreeSpace | LogDistance | DualSlope | TwoRay, Field(discriminator="kind")]


class Shadowing(Section):
    """`[radio.shadowing]`: log-normal, the same both ways of a link, and alike where both ends are alike."""

    sigma_db: float = Field(3.0, ge=0, le=50)
    decorrelation_m: float = Field(25.0, gt=0, le=1e6)


class Fading(Section):
    """`[radio.fading]`: Nakagami, drawn for each frame and receiver.

    `m` are the shapes up to each of `until_m`, in metres, and beyond the last.
    """

    m: tuple[Annotated[float, Field(ge=0.5, le=100)], ...] = (1.5, 0.75)
    until_m: tuple[Annotated[float, Field(gt=0, le=1e9)], ...] = (80.0,)

    @model_validator(mode="after")
    def _a_shape_for_each_stretch(self) -> Fading:
        if len(self.m) != len(self.until_m) + 1:
            raise ValueError(f"{len(self.m)} shapes m need {len(self.m) - 1} distances until_m between them")
        if any(far <= near for near, far in pairwise(self.until_m)):
            raise ValueError("the distances until_m must grow")
        return self


class Receiver(Section):
    """`[radio.receiver]`: detects a frame from `min_rssi_dbm` and `min_snr_db` above noise and interference on.

    Noise is `noise_dbm` in 10 MHz and the receiver's own `noise_figure_db`.
    """

    noise_dbm: float = Field(-104.0, ge=-300, le=100)
    noise_figure_db: float = Field(7.0, ge=0, le=100)
    min_snr_db: float = Field(4.0, ge=-50, le=100)
    min_rssi_dbm: float = Field(-82.0, ge=-300, le=100)


class Mac(Section):
    """`[radio.mac]`: listen before talking, with the parameters of an access category of 802.11p.

    The medium is busy where the sum of all signals is at least `carrier_sense_dbm`.
    """

    access_category: Literal["VO", "VI", "BE", "BK"] = "BE"
    carrier_sense_dbm: float = Field(-85.0, ge=-300, le=100)


class EtsiReactive(Section):
    """`[radio.congestion]`, the reactive table of ETSI TS 102 687: busier channels, longer pauses between frames.

    One state up or down each 100 ms, towards the one of whose busy ratios in `busy` is not yet reached; `pause_ms`
    are the states' least times between two frames of a sender. `waiting` frames are held back, the newest.
    """

    kind: Literal["etsi"]
    busy: tuple[Annotated[float, Field(gt=0, lt=1)], ...] = (0.3, 0.4, 0.5, 0.65)
    pause_ms: tuple[Annotated[float, Field(ge=0, le=60_000)], ...] = (50.0, 100.0, 200.0, 250.0, 1000.0)
    waiting: int = Field(1, ge=1, le=1_000_000)

    @model_validator(mode="after")
    def _a_pause_for_each_state(self) -> EtsiReactive:
        if len(self.pause_ms) != len(self.busy) + 1:
            raise ValueError(f"{len(self.pause_ms)} pauses need {len(self.pause_ms) - 1} busy ratios between them")
        if any(more <= less for less, more in pairwise(self.busy)):
            raise ValueError("the busy ratios must grow")
        return self


class Limeric(Section):
    """`[radio.congestion]`, LIMERIC as ETSI TS 102 687 has it: every sender's share of the channel's time adapts.

    Each 200 ms: share ← (1 - `alpha`) share + `beta` (`target` - busy ratio), by no more than `most_up` and
    `most_down`, within `least` and `most`.
    """

    kind: Literal["limeric"]
    alpha: float = Field(0.016, gt=0, lt=1)
    beta: float = Field(0.0012, gt=0, lt=1)
    target: float = Field(0.68, gt=0, lt=1)
    most_up: float = Field(0.0005, gt=0, lt=1)
    most_down: float = Field(0.00025, gt=0, lt=1)
    least: float = Field(0.0006, gt=0, lt=1)
    most: float = Field(0.03, gt=0, le=1)
    waiting: int = Field(1, ge=1, le=1_000_000)


Congestion = Annotated[EtsiReactive | Limeric, Field(discriminator="kind")]
