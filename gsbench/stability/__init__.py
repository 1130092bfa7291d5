"""Compare models and backends with high-precision results on numerically hard inputs, and check error bounds."""
