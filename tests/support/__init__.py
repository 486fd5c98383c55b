"""What several test files share: small logs and runs, oracles, and jobs for worker processes."""
