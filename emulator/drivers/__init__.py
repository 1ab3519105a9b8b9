"""Drivers: one engine driven in lockstep or in real time, with live processes or all in one process."""
