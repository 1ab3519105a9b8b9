"""The truth of a run, hidden from programs: motion of the vehicles, and errors of their GNSS receivers."""
