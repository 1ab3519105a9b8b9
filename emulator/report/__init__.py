"""Pages about runs: the report of one, the index of all, and two side by side."""
