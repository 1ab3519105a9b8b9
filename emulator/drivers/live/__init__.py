"""The live driver: real processes over Zenoh, in lockstep or in real time.

`session` joins the parts of a run: `inbox` (messages from Zenoh's threads), `joining` (the start), `supervisor`
(processes and their states), `reconnection` (restarts of the emulator's connection), `observer_feed`, and a driver
for each pacing: `lockstep_driver` and `realtime_driver`.
"""

from emulator.drivers.live.session import run_live

__all__ = ["run_live"]
