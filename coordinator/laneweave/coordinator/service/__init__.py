"""The planning service: plans at the request of clients on the network.

Entry points: `server.PlanningService`, `client.PlanClient` and `client.AsyncPlanClient`. Uses
`planning` only; imported by `coordinator.core` and by launch.
"""
