"""Deployments: certificates, configuration checks, vehicles of an agent process.

Entry points: `config_check.check_deployment`, `certificate_authority.make_authority` and
`assigned_vehicles.assigned_vehicles`. Imported by `cli` and benchmarks/.
"""
