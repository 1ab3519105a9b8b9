"""Small faults in vnet itself, and the tests that are to find them: `python -m tests.hunt.mutants [NAME ...]`.

Each mutant is one text of a file in place of another. It is put into a copy of the tree, in which the tests of its
package run until the first fails, for at most `LIMIT_S` of processor time. Prints for each mutant the test that
found it. Ends with status 1 if a mutant was not found, or if its text does not stand exactly once in its file.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.support.paths import ROOT

SEED = 33
"""Seed of the order in which mutants run, so that `--most N` is a random sample."""
LIMIT_S = 180
LEFT_OUT = shutil.ignore_patterns(".*", "__pycache__", "runs", "build", "site", "*.egg-info")
TESTS = {
    "emulator/radio": ["tests/emulator/radio"],
    "emulator/drivers": [f"tests/emulator/drivers{file}" for file in ("/test_lockstep.py", "/test_windows.py", "")],
    "emulator/scenario": ["tests/emulator/scenario", "tests/emulator/drivers/test_backbone.py"],
    "emulator/checks": ["tests/emulator/checks"],
    "agents/cooperative": ["tests/agents/cooperative"],
}
"""Tests of each package, in the order in which they run."""


@dataclass(frozen=True)
class Mutant:
    """One fault: `new` in place of `old` in `file`; `name` is for the command line."""

    name: str
    file: str
    old: str
    new: str


TABLE = r"""
emulator/radio
detection | medium | if other.on_air_ns + DETECTION_NS > sent | if other.on_air_ns > sent
idle | medium | self.idle_ns, time_ns, where=before & ~sensed | self.idle_ns, time_ns, where=~sensed
reflection | propagation | (here_m + there_m) / reflected_m, dist | (here_m + there_m) / direct_m, dist
shadowing | propagation | np.exp(-2 * distance_m / self._dec | np.exp(-distance_m / self._dec
capture | reception | enough = power_mw * (1 + self._ratio) >= | enough = power_mw >=
interference | reception | others_mw = np.maximum(total_mw - own_mw, 0.0) | others_mw = total_mw
tail bits | dot11p | (SERVICE_AND_TAIL_BITS + 8 * size_bytes) | (8 * size_bytes)
smoothing | csma | + 0.25 * both_ratios | + 0.5 * self._meter.busy_ratio[over]
window | csma | (self.window + 1 << attempts) - 1, self | self.window + 1 << attempts, self
tick | reception | -(-arrival_ns // self._tick_ns) | (arrival_ns // self._tick_ns)
peer cap | topology | candidate & (rank < self._max_peers) | candidate & (rank <= self._max_peers)
nav | unicast | max(idle_ns, int(self._nav_ns[node]), int( | max(idle_ns, int(
emulator/drivers
lookahead | lockstep | [time_ns + self._lookahead_ns, (time | [time_ns + 2 * self._lookahead_ns, (time
pass | lockstep | emulation.pass_to(self._end_ns - 1) | emulation.pass_to(self._end_ns)
show | lockstep | self._show(self._end_ns - 1) | self._show(self._end_ns)
control | lockstep | control_ns is None or control_ns > next_ns | control_ns is None or control_ns >= next_ns
planned | lockstep | is not None and next_ns < self._end_ns: | is not None and next_ns <= self._end_ns:
emulator/scenario
backbone | scenario | return min(radio_ns, max(int( | return max(radio_ns, max(int(
emulator/checks
killed | run | p.start_ns <= event.time_ns <= p.end_ns + recorded.guard_ns | p.start_ns <= event.time_ns
late | run | if at_least <= LATE_SHARE_LIMIT else Verdict.UNKNOWN | if at_least <= 1 else Verdict.UNKNOWN
states | run |  or len(recorded.states) != due * len(recorded.node_ids): | :
band | radio | not expected - away <= seen <= expected + away | not seen <= expected + away
arrival | channel | there & (recorded.arrival_ns <= recorded.sent_ns) | there & (recorded.arrival_ns < 0)
misbehaviour | faults | originals[times_sent != _due( | originals[times_sent < _due(
agents/cooperative
gate | estimator | np.einsum("nii->n", covariances_m2) / 2 | np.einsum("nii->n", covariances_m2)
agents/cooperative/cmm
walk | rbpf | config.common_sigma_m * np.sqrt(1 - keep**2) | config.common_sigma_m * np.sqrt(1 - keep)
acceleration | tracks | half = elapsed_s**2 / 2 | half = elapsed_s**2
metropolis | fusion | weights[0] = 1 - (count - 1) / (1 + max_degree) | weights[0] = 1 / (1 + max_degree)
offset | own_kalman | (stays * offset, s + dt_s * v, v) | (offset, s + dt_s * v, v)
evidence | map_matching | np.maximum(0.0, 1 - since_s / self._lateral_tau_s) | 1 - 0 * since_s
"""
"""The mutants of each folder: name, file, the text that stands in it, and the one in its place."""


def _mutants() -> Iterator[Mutant]:
    folder = ""
    for line in TABLE.strip().splitlines():
        name, *parts = line.split(" | ")
        if parts:
            yield Mutant(name, f"{folder}/{parts[0]}.py", *parts[1:])
        else:
            folder = name


MUTANTS = list(_mutants())


def mutated(mutant: Mutant) -> str:
    """Return the text of a mutant's file with its fault."""
    text = (ROOT / mutant.file).read_text(encoding="utf-8")
    if (count := text.count(mutant.old)) != 1:
        sys.exit(f"mutant {mutant.name!r} does not apply: {mutant.old!r} stands {count} times in {mutant.file}")
    return text.replace(mutant.old, mutant.new)


def found_by(tree: Path, paths: list[str]) -> str:
    """Run tests in a copy of the tree until the first fails, quick ones first; return it, or why there is none."""
    environment = {**os.environ, "PYTHONPATH": str(tree)}
    for which in ("not slow", "slow"):
        options = ["-x", "-n", "0", "-p", "no:cacheprovider", "--tb=no", "-o", "addopts=", "-m", which]
        options.append("--hypothesis-profile=first")
        words = ["prlimit", f"--cpu={LIMIT_S}", sys.executable, "-m", "pytest", *options, *paths]
        done = subprocess.run(words, cwd=tree, env=environment, capture_output=True, text=True, timeout=1800)
        if failed := re.search(r"^(?:FAILED|ERROR) (\S+)", done.stdout, re.MULTILINE):
            return failed[1]
        if done.returncode not in (0, 5):  # 5: there are none
            ended = done.returncode in (-signal.SIGXCPU, -signal.SIGKILL)
            return "NOT FOUND in time" if ended else done.stdout[-300:]
    return "NOT FOUND"


def main() -> None:
    """Run the named mutants, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of mutants (all)")
    parser.add_argument("--most", type=int, default=len(MUTANTS), help="run a random sample of so many")
    asked = parser.parse_args()
    names = asked.names or random.Random(SEED).sample([each.name for each in MUTANTS], asked.most)
    texts = {each.name: mutated(each) for each in MUTANTS}
    missed = 0
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(ROOT, tree, ignore=LEFT_OUT)
        for mutant in (each for name in names for each in MUTANTS if each.name == name):
            (tree / mutant.file).write_text(texts[mutant.name], encoding="utf-8")
            began = time.monotonic()
            found = found_by(tree, next(paths for of, paths in TESTS.items() if mutant.file.startswith(of)))
            shutil.copy(ROOT / mutant.file, tree / mutant.file)
            missed += found.startswith("NOT FOUND")
            print(f"{mutant.name:14} {time.monotonic() - began:4.0f} s  {found}", flush=True)
    print(f"{len(names) - missed} of {len(names)} found")
    sys.exit(missed > 0)


if __name__ == "__main__":
    main()
