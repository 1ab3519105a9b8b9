"""Testing vehicle programs: a pytest plugin, strategies that draw faults, and campaigns of random faults."""
