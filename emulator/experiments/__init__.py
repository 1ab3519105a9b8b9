"""Experiments: many runs of one question, their tables and their pictures."""
