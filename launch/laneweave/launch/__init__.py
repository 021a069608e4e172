"""Command line, runs, faults, observation, sweeps, reports and benchmarks."""
