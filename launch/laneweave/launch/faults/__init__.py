"""Faults of a run: specification, schedule, injection, and recovery times.

Entry points: `specification.load_faults` reads a fault file, `injection.FaultInjection` applies it
to the processes of a local run or the roles of a simulated one. `presets/` holds the named fault
files. Imported by `run` and `cli`; imports `observe`.
"""
