"""Roads as vehicles know them: straight lanes, and the map of a city with its index."""
