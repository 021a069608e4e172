"""A leader's ballots in both operations: prepare, promise, plan, accept.

Entry point: `ballot_round.BallotRound` with `PLAN_RULES`, the transitions that both operations
share. `formations.leader` and `rolling.transfer` add the transitions for ballots that fail.
Imported by `formations` and `rolling` only.
"""
