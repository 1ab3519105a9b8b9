"""Playing the scenes: each with a process of its own, at one router."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from emulator.scenario.scenario import Scenario
from emulator.testing.conformance import lockstep, realtime, scene
from emulator.testing.conformance.findings import Findings
from emulator.testing.conformance.scene import PLACEHOLDERS, AgentUnderTest, Bench, Scene, SceneOverError
from emulator.world.world import build_world
from vnet.errors import VnetError, did_you_mean
from vnet.transport.access import Access, certifier, is_tls

PATIENCE_S = 5.0
"""Time that an answer may take: as long as an emulator waits for a process to end."""
Pacing = Literal["lockstep", "realtime"]

SCENES: dict[str, tuple[Pacing, Callable[[Scene], None]]] = {
    "joining": ("lockstep", scene.joining),
    "refusal": ("lockstep", scene.refusal),
    "lockstep": ("lockstep", lockstep.run),
    "lockstep-restart": ("lockstep", lockstep.restart),
    "lockstep-ended": ("lockstep", lockstep.ended),
    "lockstep-malformed": ("lockstep", lockstep.malformed),
    "lockstep-lost": ("lockstep", lockstep.lost),
    "lockstep-away": ("lockstep", lockstep.away),
    "realtime": ("realtime", realtime.run),
    "realtime-restart": ("realtime", realtime.restart),
    "realtime-elsewhere": ("realtime", realtime.elsewhere),
    "realtime-malformed": ("realtime", realtime.malformed),
    "realtime-lost": ("realtime", realtime.lost),
    "realtime-away": ("realtime", realtime.away),
}
"""The scenes by name, in the order in which they are played."""


@dataclass(frozen=True)
class Conformance:
    """Scenes to be played, and the command that they are played against."""

    command: Sequence[str]
    scenario: Scenario
    scenes: Sequence[str]
    listen: str = "tcp/127.0.0.1:0"
    patience_s: float = PATIENCE_S

    def __post_init__(self) -> None:
        """Raises VnetError for an unknown scene, and for a command that cannot know where to connect."""
        for name in self.scenes:
            if name not in SCENES:
                known = ", ".join(SCENES)
                raise VnetError(f"--scene {name}: unknown{did_you_mean(name, SCENES)}; there are {known}")
        for placeholder in PLACEHOLDERS:
            if not any(placeholder in word for word in self.command):
                names = " ".join(PLACEHOLDERS)
                raise VnetError(f"the command has no {placeholder}; it needs all of {names}")

    def play(self, on_scene: Callable[[str], None] = lambda name: None) -> Findings:
        """Play the scenes; `on_scene` is given each name. Raises VnetError if the command cannot be started."""
        world = build_world(self.scenario)
        node = world.node_ids[0]
        certify = certifier(self.listen) if is_tls(self.listen) else None
        access = Access.create(self.scenario.run.name, [[node]], certify)
        findings = Findings()
        with tempfile.TemporaryDirectory(prefix="vnet-") as name:
            folder = Path(name)
            for scene_name in self.scenes:
                on_scene(scene_name)
                findings.begin(scene_name)
                pacing, act = SCENES[scene_name]
                agent = AgentUnderTest(self.command, folder / "agent.log")
                with Bench(access, self.listen, agent, folder) as bench, suppress(SceneOverError):
                    act(Scene(bench, findings, self.scenario, world, pacing, self.patience_s))
        return findings
