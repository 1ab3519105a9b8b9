"""Running programs: the event loop on virtual time, and the host of the programs of one process."""
