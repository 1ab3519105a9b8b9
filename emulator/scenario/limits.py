"""Bounds of the numbers in a scenario: whatever is within them can be computed with."""

DAY_S = 86_400
"""No time in a scenario is longer, so that nanoseconds stay far within 64 bits."""
FAR_M = 1e9
"""No length in a scenario is larger, so that squares stay finite and millimetres mean something."""
WILD_M = 1e5
"""No standard deviation is larger, so that fixes stay near enough for frames to say."""
FAR_S = 1e11
"""Times of files, which may be seconds since 1970, are within ± three thousand years."""
