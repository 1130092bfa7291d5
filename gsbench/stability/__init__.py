"""Compare models and backends with an oracle on numerically hard cases, and check the bounds of the defaults."""
