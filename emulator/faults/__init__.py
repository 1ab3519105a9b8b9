"""Faults: where each acts, when, and what it does to links, senders, sensors, clocks and processes."""
