"""Export of runs to other tools' formats: pcapng for Wireshark, MCAP for Foxglove and Rerun, CSV for others."""
