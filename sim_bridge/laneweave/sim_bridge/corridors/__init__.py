"""Corridors of SUMO simulations: the part of a network that laneweave drives.

`sumo_simulation` reads a simulation, `corridor` and `scenario_tables` derive the road and its
scenario, `corridor_setup` its arrivals; `corridor_world` displays and hands over vehicles. Entry
point: `sumo_corridor`; imported by `road_sources`, and by `laneweave.launch` for commands and
comparisons.
"""
