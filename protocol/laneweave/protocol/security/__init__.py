"""Rights of processes on the network, and the certificates that prove their identities.

Entry points: `connection.Access` (endpoint, realm and identity of a process), `access_control` (a
router's rules, derived from the table of topics), `certificates` (checks before use). Imported by
`transports.zenoh`, the roles and launch.
"""
