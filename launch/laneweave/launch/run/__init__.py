"""One run: its processes, its progress, its outcome.

Entry points: `local_run` (processes on this machine over Zenoh), `simulated_run` (virtual time),
`reference_run` (the paper's rules, LC2013). Imported by `cli`, `sweep` and `bench`.
"""
