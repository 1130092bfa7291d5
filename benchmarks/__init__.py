"""What the native kernels cost, beside what this machine could do: `python -m benchmarks`."""
