"""Hostile input: everything that reads bytes of others, under hypothesis and under a coverage-guided fuzzer."""
