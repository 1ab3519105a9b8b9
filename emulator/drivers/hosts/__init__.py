"""Several hosts in one run: `vnet host` starts the agents of a host and speaks for them with one connection.

`host` is the process on the host: `relay` bundles what its agents say, `down` is their router, `up` the connection
to the emulator, and `retrieval` reads what agents leave behind. `messages` pass between it and the emulator, whose
side is `emulator/drivers/live/fleet.py`.
"""
