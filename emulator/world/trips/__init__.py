"""Trips: how vehicles drive, read from what others recorded or simulated."""
