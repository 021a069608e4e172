"""The planning service: plans requests from clients on the network.

Entry points: `server.PlanningService`, `client.PlanClient` and `client.AsyncPlanClient`. Uses
`planning` only; imported by `coordinator.core` and by launch.
"""
