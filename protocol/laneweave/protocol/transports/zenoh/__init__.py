"""The transport over Zenoh, and the runner that drives a core over it in real time.

Entry points: `runner.run_core` and `transport.ZenohTransport`. `transport` is the only module that
imports zenoh.
"""
