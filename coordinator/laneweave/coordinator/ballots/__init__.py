"""One ballot of a leader, as both operations use it: prepare, promise, plan, accept.

Entry point: `ballot_round.BallotRound` (state and messages) with `ballot_rules`, the rows of the
transition table that both operations share. `formations.leader` and `rolling.transfer` add what an
operation does where a ballot cannot go on. Imported by `formations` and `rolling` only.
"""
