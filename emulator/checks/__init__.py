"""Checks: what must be true of a run, one file a subject; `judge` puts them together."""
