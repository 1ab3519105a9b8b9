"""A stand-in for libsumo, as far as vnet uses it: one straight road, whose vehicles keep their distance.

The route file of the configuration is JSON: `vehicles` with `id`, `depart` (s), `x` (m) and `speed` (m/s), and what
is to go wrong: `dies`, `hangs` or `fails` at a time in s. It lets tests run where SUMO is not installed.
"""

import json
import os
import re
import time
from pathlib import Path
from typing import Any

LENGTH_M, END_M, GAP_M, BRAKING = 5.0, 400.0, 4.0, 4.5
_now_ms = _step_ms = 0
_plan: dict[str, Any] = {}
_there: dict[str, dict[str, float]] = {}
_told: dict[str, float] = {}
_departed: list[str] = []
_lanes: dict[str, int] = {}


def start(command: list[str]) -> tuple[int, str]:
    global _plan, _step_ms
    options = dict(zip(command[1::2], command[2::2], strict=True))
    path = Path(options["--configuration-file"])
    named = re.search(r'route-files value="([^"]+)"', path.read_text())
    assert named is not None
    _plan = json.loads((path.parent / named[1]).read_text())
    _plan["network"] = str(path.parent / "a.net.xml")
    _plan["seed"] = int(options["--seed"])
    _step_ms = round(float(options["--step-length"]) * 1000)
    return 22, "SUMO fake"


def simulationStep(until_s: float = 0.0) -> None:
    _step()
    while _now_ms < until_s * 1000:
        _step()


def close() -> None:
    Path(_plan.get("closes", os.devnull)).write_text("closed")


def _step() -> None:
    global _now_ms
    _go_wrong(_now_ms / 1000)
    for name, car in sorted(_there.items(), key=lambda each: -each[1]["x"]):
        wished = _told.get(name, car["wish"])
        ahead = [o for other, o in _there.items() if o["x"] > car["x"] and _lanes[other] == _lanes[name]]
        if name not in _told and ahead:
            leader = min(ahead, key=lambda other: other["x"])
            if leader["x"] - car["x"] - LENGTH_M < GAP_M + 2 * car["speed"]:
                wished = min(wished, leader["speed"])
        before = car["speed"]
        car["speed"] = wished if name in _told else max(wished, before - BRAKING * _step_ms / 1000)
        car["acceleration"] = (car["speed"] - before) * 1000 / _step_ms
        car["x"] += car["speed"] * _step_ms / 1000
        car["distance"] += car["speed"] * _step_ms / 1000
    for name in [name for name, car in _there.items() if car["x"] > END_M]:
        del _there[name]
    _departed.clear()
    for each in _plan["vehicles"]:
        if round(each["depart"] * 1000) == _now_ms:
            _departed.append(each["id"])
            speed = each["speed"] + 0.001 * (_plan["seed"] % 1000)
            still = {"acceleration": 0.0, "distance": 0.0}
            _there[each["id"]] = {"x": each["x"], "speed": speed, "wish": speed, "at": each["depart"]} | still
            _lanes[each["id"]] = 0
    _now_ms += _step_ms


def _go_wrong(now_s: float) -> None:
    if now_s >= _plan.get("fails", 1e9):
        os.write(2, b"Warning: ignore me\nError: Vehicle 'x' has no valid route.\n")
        raise RuntimeError("Process Error")
    if now_s >= _plan.get("dies", 1e9):
        os.abort()
    if now_s >= _plan.get("hangs", 1e9):
        time.sleep(1000)


class Clash:
    def __init__(self, collider: str, victim: str) -> None:
        self.collider, self.victim = collider, victim
        self.colliderSpeed, self.victimSpeed = _there[collider]["speed"], _there[victim]["speed"]


class simulation:
    @staticmethod
    def getTime() -> float:
        return _now_ms / 1000

    @staticmethod
    def getOption(name: str) -> str:
        return {"net-file": str(_plan["network"])}[name]

    @staticmethod
    def getNetBoundary() -> tuple[tuple[float, float], tuple[float, float]]:
        return (0.0, 0.0), (END_M, 10.0)

    @staticmethod
    def getDepartedIDList() -> tuple[str, ...]:
        return tuple(_departed)

    @staticmethod
    def getCollisions() -> list[Clash]:
        pairs = [
            (a, b) for a, one in _there.items() for b, two in _there.items() if 0 < two["x"] - one["x"] < LENGTH_M
        ]
        return [Clash(*pair) for pair in pairs if _lanes[pair[0]] == _lanes[pair[1]]]


class junction:
    @staticmethod
    def getIDList() -> tuple[str, ...]:
        return ("west", "east")

    @staticmethod
    def getPosition(name: str) -> tuple[float, float]:
        return (0.0, 5.0) if name == "west" else (END_M, 5.0)


class trafficlight:
    @staticmethod
    def getIDList() -> tuple[str, ...]:
        return ("b#1", "a")

    @staticmethod
    def getRedYellowGreenState(name: str) -> str:
        return "Gr" if _now_ms <= 1000 else "rG"


class edge:
    @staticmethod
    def getLaneNumber(name: str) -> int:
        return 2


class vehicle:
    @staticmethod
    def getIDList() -> tuple[str, ...]:
        return tuple(_there)

    @staticmethod
    def getDeparture(name: str) -> float:
        return _there[name]["at"]

    @staticmethod
    def setSpeed(name: str, speed: float) -> None:
        if speed < 0:
            _told.pop(name, None)
        else:
            _told[name] = speed

    @staticmethod
    def setSpeedMode(name: str, mode: int) -> None:
        assert mode in (31, 32)

    @staticmethod
    def setLaneChangeMode(name: str, mode: int) -> None:
        assert mode in (1621, 1537)

    @staticmethod
    def getRoadID(name: str) -> str:
        return "road"

    @staticmethod
    def getLaneIndex(name: str) -> int:
        return _lanes[name]

    @staticmethod
    def changeLane(name: str, lane: int, duration_s: float) -> None:
        _lanes[name] = lane

    @staticmethod
    def getPosition(name: str) -> tuple[float, float]:
        return _there[name]["x"], 5.0 + 3.0 * _lanes[name]

    @staticmethod
    def getAngle(name: str) -> float:
        return 90.0

    @staticmethod
    def getSpeed(name: str) -> float:
        return _there[name]["speed"]

    @staticmethod
    def getAcceleration(name: str) -> float:
        return _there[name]["acceleration"]

    @staticmethod
    def getDistance(name: str) -> float:
        return _there[name]["distance"]

    @staticmethod
    def getLateralLanePosition(name: str) -> float:
        return 0.25

    @staticmethod
    def getLeader(name: str, range_m: float) -> tuple[str, float] | None:
        car = _there[name]
        ahead = [
            (o["x"], other) for other, o in _there.items() if o["x"] > car["x"] and _lanes[other] == _lanes[name]
        ]
        if not ahead:
            return None
        x, leader = min(ahead)
        return leader, x - car["x"] - LENGTH_M - 2.5

    @staticmethod
    def getMinGap(name: str) -> float:
        return 2.5

    @staticmethod
    def getLength(name: str) -> float:
        return LENGTH_M

    @staticmethod
    def getAccel(name: str) -> float:
        return 2.5

    @staticmethod
    def getDecel(name: str) -> float:
        return BRAKING

    @staticmethod
    def getEmergencyDecel(name: str) -> float:
        return 8.0

    @staticmethod
    def getMaxSpeed(name: str) -> float:
        return 30.0
