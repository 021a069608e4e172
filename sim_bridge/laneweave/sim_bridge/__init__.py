"""The simulated world: demand, vehicles' bodies and motion controllers, SUMO, measurement.

Entry points: `core.BridgeCore` (lockstep ticks with agents), `process.run_bridge` (over Zenoh),
`baselines.reference_road` (methods without agents). Imported by launch only.
"""
