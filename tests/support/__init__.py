"""Shared by test files: small logs and runs, oracles, and jobs for worker processes."""
