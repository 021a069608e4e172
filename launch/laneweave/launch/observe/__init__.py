"""Observation of a deployment: observed state, health, metrics server.

Entry points: `observer.Observer` with its `road_view.RoadView`, `status.status_of`,
`metrics_server.serve_metrics`. An observer publishes nothing. Imported by `faults`, `run`, `watch`,
`bench` and `cli`.
"""
