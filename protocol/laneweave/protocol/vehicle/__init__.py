"""Rules that vehicles and planners share: motion, braking, plan execution.

Entry points: `execution.PlanExecution` (the vehicle's side of the execution protocol, rules V1 to
V7), `motion` (integration and limits), `braking` (the emergency brake). Pure functions and state
machines; imported by agents, coordinators and the bridge.
"""
