"""The simulated world: demand, plant, SUMO, measurement."""
