"""Trips: trajectories of vehicles, recorded, simulated by SUMO, or generated."""
