"""Units: times are integer nanoseconds from the start of a run, everywhere but in what people read and write."""

NS_PER_S = 1_000_000_000
NS_PER_MS = 1_000_000
