"""The checker: what every run must satisfy, whatever faults happen.

Entry point: `checker.Checker`. It observes bodies, motion controllers and sent messages, and shares
no code with what it checks.
"""
