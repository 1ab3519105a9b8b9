"""`[world]`: the truth that the vehicles never see, their receivers included."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from emulator.scenario.network import Driven, Ranging, control_step_ns
from emulator.scenario.program import Entry
from emulator.scenario.sections import DAY_S, FAR_M, FAR_S, WILD_M, Section, Switch
from vnet.units import NS_PER_MS, NS_PER_S


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
