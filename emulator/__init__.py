"""emulator: everything that vehicles live in. It stands on vnet and never imports agents."""
