"""Help for deployments: certificates, configuration checks, which vehicles an agent process drives.

Entry points: `config_check`, `certificate_authority`. Imported by `cli`.
"""
