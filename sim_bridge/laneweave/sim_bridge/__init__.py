"""The simulated world: demand, bodies and motion controllers of vehicles, SUMO, recording.

Entry points: `simulated_road.SimulatedRoad` (what happens in a tick), `core.BridgeCore` (lockstep
with agents), `process.run_bridge` (over Zenoh), `baselines.reference_road` (methods without
agents). Imported by launch only.
"""
