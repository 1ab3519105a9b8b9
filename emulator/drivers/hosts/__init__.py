"""Several hosts in one run: `vnet host` starts the agents of a host and speaks for them with one connection.

`host` is the process on the host: `Relay` bundles what its agents say, `Down` is their router, `Up` the connection
to the emulator. `retrieval` reads what agents leave behind. `messages` pass between it and the emulator, whose side
is `emulator/drivers/live/fleet.py`.
"""
