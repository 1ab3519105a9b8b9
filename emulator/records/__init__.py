"""The records of a run: what is written into its folder, and the one way to read it back."""
