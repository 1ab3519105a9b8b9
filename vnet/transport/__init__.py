"""The transport between agents and emulator: keys, messages, sessions, and who may do what on the router."""
