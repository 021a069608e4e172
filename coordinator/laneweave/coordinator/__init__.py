"""The coordinator: election, ballots, both operating modes, planners, planning service."""
