"""Runs in formats that other tools read: pcapng for Wireshark, MCAP for Foxglove and Rerun, CSV for the rest."""
