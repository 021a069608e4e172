"""Rules that vehicles and planners share: motion, braking, territory, plan execution.

Entry points: `plan_execution.PlanExecution` (the vehicle's side of the protocol, rules V1 to V8),
`territory.territory_of` (blocks or cells), `motion` (integration and limits), `emergency_brake`.
Pure functions and state machines; imported by agents, coordinators and the bridge.
"""
