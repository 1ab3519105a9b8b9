"""Digital maps of the vehicles: straight lanes, and the map of a city with its index."""
