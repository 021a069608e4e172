"""The road and its traffic: demand, entry, formation building, who is in charge of a vehicle.

Entry points: `roadside.Roadside` (meters vehicles in), `vehicle` (one vehicle on the road),
`attendance` (agents and caretakers). Imported by `sim_bridge.core`.
"""
