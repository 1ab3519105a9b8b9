"""agents: programs that run in a vehicle. They stand on vnet and never import the emulator."""
