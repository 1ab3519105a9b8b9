"""What a run leaves for people to look at: its report, the index of all runs, and two runs side by side."""
