"""Looking at a deployment from outside: observer, status, health, metrics server.

Entry points: `observer.Observer`, `status`. An observer publishes nothing. Imported by `run`,
`watch`, `report` and `cli`.
"""
