"""`make bench`: the figures that vnet means to reach, measured on this machine. Benchmarks, not tests."""
