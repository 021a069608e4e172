"""SUMO: the road's network, bodies that it shows (`world`), vehicles that it drives (`traffic`).

Entry points: `world.SumoWorld`, `traffic.SumoTraffic`. `simulation` is the only module that imports
libsumo. Imported by `sim_bridge.process`, `baselines` and launch.
"""
