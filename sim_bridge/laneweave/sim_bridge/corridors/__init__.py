"""Corridors of SUMO simulations: the part of a network that laneweave drives.

`network_reading` and `sumo_demand` read a simulation, `corridor` and `scenario_tables` derive the
road and its scenario, `corridor_world` displays and hands over vehicles. Entry point:
`corridor_reading`; imported by `road_sources`, and by `laneweave.launch` for commands and
comparisons.
"""
