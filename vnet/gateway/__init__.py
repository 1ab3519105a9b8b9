"""Zenoh programs as vehicles: what of their traffic crosses the radio, and how."""
