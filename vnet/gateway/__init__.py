"""Zenoh programs as vehicles: the messages that cross the radio, and their frames."""
