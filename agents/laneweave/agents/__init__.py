"""The vehicle agent: executes plans and drives one vehicle.

Entry points: `core.AgentCore` (one vehicle), `host.AgentHost` (the vehicles of a process),
`process.run_agents` (over Zenoh). Imported by launch only.
"""
