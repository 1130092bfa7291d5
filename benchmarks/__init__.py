"""What the native kernels cost, beside what this machine could do: `python -m benchmarks`."""

import gsbench  # noqa: F401  before torch: how its threads wait is settled as it loads
