"""The two implementations of `runtime.transport.Transport`: Zenoh, and a simulated network.

Both pass the same contract tests. Cores do not import them; process modules and launch do.
"""
