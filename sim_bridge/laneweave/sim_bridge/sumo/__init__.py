"""SUMO: the road's network, displayed bodies (`sumo_world`) and driven vehicles (`traffic`).

Entry points: `sumo_world.SumoWorld`, `traffic.SumoTraffic`. `simulation` is the only module that
imports libsumo. Imported by `sim_bridge.process`, `baselines` and launch.
"""
