"""A training step by the CUDA kernels: what Python asks of a GPU, which bounds the step of a small scene."""

from collections import Counter
from typing import Any

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench.kernels.library import CudaLibrary
from gsbench.train.divergence import LOOK_EVERY

_aten = torch.ops.aten
WITHOUT_LAUNCH = {
    _aten.empty.memory_format,
    _aten.empty_strided.default,
    _aten.empty_like.default,
    _aten.new_empty.default,
    _aten.detach.default,
}


class Calls(TorchDispatchMode):
    """Counts the torch operations that launch something on a GPU: all but views and allocations."""

    def __init__(self) -> None:
        super().__init__()
        self.counted: Counter[str] = Counter()

    def __torch_dispatch__(self, operation: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not operation.is_view and operation not in WITHOUT_LAUNCH:
            self.counted[str(operation)] += 1
        return operation(*args, **(kwargs or {}))


@pytest.mark.usefixtures("cuda_device")
@pytest.mark.parametrize(
    ("model", "options", "kernels", "operations"),
    [
        ("4dgs", (), 50, 139),
        ("4dgs", ("optim=sparse_adam",), 50, 141),
        ("7dgs_noagr", (), 50, 132),
        ("7dgs", (), 58, 256),
    ],
)
def test_calls_of_a_step(
    model: str, options: tuple[str, ...], kernels: int, operations: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a change after which a step of four views launches more: each call takes a GPU at least two microseconds,
    and Python five; and a value that the CPU waits for."""
    pytest.importorskip("hydra", reason="needs hydra, which composes the settings of a training")
    from tiny_training import trainer

    fitted, called, call = trainer(model, "train.batch_size=4", *options), Counter[str](), CudaLibrary.call

    def count(library: CudaLibrary, name: str, *arguments: Any) -> None:
        called[name] += 1
        call(library, name, *arguments)

    # as on a GPU
    fitted.finite_check.every, fitted.optimizer.skip = LOOK_EVERY, fitted.finite_check.skip
    monkeypatch.setattr(fitted.gradients, "_signature", lambda *_: None)
    fitted.step, fitted.schedule.densify_stop = 90, 100  # when all parts of a model learn
    fitted.train_step()
    fitted.step = 91
    monkeypatch.setattr(CudaLibrary, "call", count)
    with Calls() as calls:
        fitted.train_step()
    assert called.total() <= kernels, called
    assert calls.counted.total() <= operations, calls.counted
    assert not [name for name in calls.counted if "local_scalar" in name or "nonzero" in name]
