"""Units of time. Times are integer nanoseconds from the start of a run, except in files and texts for people."""

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
