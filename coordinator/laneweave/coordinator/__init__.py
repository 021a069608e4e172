"""The coordinator: election, ballots, both operations, planners and the planning service."""
