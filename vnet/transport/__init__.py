"""The transport between agents and emulator: keys, messages, sessions, and access rules of the router."""
