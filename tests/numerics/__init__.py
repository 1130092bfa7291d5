"""Audit models and backends on numerically hard inputs: their errors against mpmath and float64, and their bounds."""
