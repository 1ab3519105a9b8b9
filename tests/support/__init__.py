"""Helpers of the tests: programs, maps, trips and recordings that several of them use."""
