"""The paper's algorithms as printed: assignments, TAPPA (Algorithm 1), CBSA (Algorithm 2).

Entry point: `tappa.Tappa`. `cbs.Improvements` lists the additions to the printed algorithms;
each can be switched off. SPPA is in `planning.shortest_paths`. Imported by `planning.solve`;
`explanation` by `laneweave plan --explain`.
"""
