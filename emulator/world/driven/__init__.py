"""Vehicles that their programs drive: dynamics, road, traffic, and the truth that comes of it."""
