"""Check by one kernel call whether several arrays are finite; a small model has about twelve gradients in each step."""

from collections.abc import Sequence

import torch
from torch import Tensor

from gsbench.kernels.headers import MAX_ADAM
from gsbench.kernels.library import library_of
from gsbench.kernels.operation import addresses, in_rows


@torch.no_grad()
def are_finite(arrays: Sequence[Tensor]) -> bool:
    """Return whether all numbers of some float32 arrays on the CPU, of any shapes, are finite."""
    rows = in_rows(list(arrays))
    for first in range(0, len(rows), MAX_ADAM):
        part = rows[first : first + MAX_ADAM]
        flags = part[0].new_zeros(1, dtype=torch.int64)
        slots = {"count": len(part), "numbers": tuple([x.numel() for x in part]), "arrays": addresses(part),
                 "out.flags": flags.data_ptr()}  # fmt: skip
        library_of("cpu").call("flag_arrays", slots, flags)
        if flags.item():
            return False
    return True
