"""Live runs: real processes over Zenoh, in lockstep or in real time.

`session` is the course of a run; `processes` are its programs, whose states the `supervisor` knows, on hosts if the
run has a `fleet` of them.
"""

from emulator.drivers.live.session import run_live

__all__ = ["run_live"]
