"""SUMO: the network it loads, bodies that it shows, and vehicles that it drives.

Entry points: `world.SumoWorld`, `traffic`. `simulation` is the only module that imports libsumo.
Imported by `sim_bridge.process`, `baselines` and launch.
"""
