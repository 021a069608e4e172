"""The vehicle agent: executes plans for one vehicle and drives it.

Entry points: `core.AgentCore` (one vehicle), `host.AgentHost` (the vehicles of a process),
`process.run_agents` (over Zenoh). Imported by launch only.
"""
