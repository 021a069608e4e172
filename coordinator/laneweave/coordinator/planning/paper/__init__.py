"""The paper's algorithms as printed: TAPPA (Algorithm 1), CBSA (Algorithm 2), SPPA.

Entry point: `tappa`. What is added to the printed algorithms is listed in `improvements` and can be
switched off. Imported by `planning.facade` and `planning.explanation`.
"""
