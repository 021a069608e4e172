"""Rights of processes on the network, and the certificates that prove their identities.

Entry points: `access.Access` (endpoint, realm and identity of a process), `rights` (a router's
rules, derived from the table of topics), `certificates` (checks before use). Imported by
`transports.zenoh` and by launch.
"""
