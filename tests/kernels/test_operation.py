"""The declaration of operations: what is refused at the door, and that kernels name the same things."""

import pytest
import torch
from test_every_operation import declared

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.library import library_of
from gsbench.kernels.operation import MOST_KNOWN, Operation
from gsbench.kernels.slices import slice_static


@pytest.mark.parametrize("operation", declared(), ids=lambda operation: operation.name)
def test_declaration_and_kernel_name_the_same(operation: Operation) -> None:
    """Catches a field that a declaration has and the kernel's structure has not: it would be dropped in silence."""
    library = library_of("cpu")
    names = {*operation.inputs, *operation.numbers} - {"with_gradient"}  # which is said by a null
    for name in names if operation.inputs else ():
        assert library.takes(operation.name, name) or library.takes(operation.name, f"out.{name}"), name
    for name in operation.outputs:
        assert library.takes(operation.name, f"out.{name}"), name
    if operation.name == "l1_ssim":
        return  # its gradient comes with its value
    has_gradient = operation.differentiable([]) if operation.inputs else ()
    for name, expected in zip(operation.inputs, has_gradient, strict=True):
        assert library.takes(f"{operation.name}_backward", f"grad.{name}") == expected, name


def test_every_kernel_is_declared() -> None:
    """Catches a kernel that no operation calls any more."""
    called = {operation.name for operation in declared()}
    without_gradient = {"adam", "adam_all", "flag_values", "flag_arrays", "count_tiles", "fill_tiles", "exact_splats",
                        "exact_image"}  # fmt: skip
    assert {name.removesuffix("_backward") for name in kernels.native().SIGNATURES} == called | without_gradient


def test_a_message_says_what_was_expected_and_what_came() -> None:
    """Catches a refusal that names no shape."""
    with pytest.raises(InputError, match=r"expected quats of shape \[4, 4\], got \[5, 4\]"):
        slice_static(torch.zeros(4, 3), torch.zeros(5, 4), torch.zeros(4))
    with pytest.raises(InputError, match="scales: expected float32, got int64"):
        slice_static(torch.zeros(4, 3).long(), torch.zeros(4, 4), torch.zeros(4))


def test_known_calls_are_not_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches models that are rendered in turns and pay for each other's checks (0.1 ms a frame), and sizes of
    Gaussians that are kept for ever."""
    matched: list[int] = []
    match = slice_static._match
    monkeypatch.setattr(
        slice_static, "_match", lambda tensors, numbers: (matched.append(1), match(tensors, numbers))[1]
    )
    for _ in range(3):
        for N in (1003, 1005):
            factors, opacities = slice_static(torch.zeros(N, 3), torch.ones(N, 4), torch.zeros(N))
            assert factors.shape == (N, 3, 3)
            assert opacities.shape == (N,)
    assert len(matched) <= 2
    for N in range(2 * MOST_KNOWN):
        slice_static(torch.zeros(N, 3), torch.ones(N, 4), torch.zeros(N))
    assert len(slice_static._known) <= MOST_KNOWN


def test_the_extension_counts_and_types_its_values() -> None:
    """Catches a call that shifts every field by one: the last door looks at number and kind."""
    native = kernels.native()
    with pytest.raises(TypeError, match="expected 7 values"):
        native.slice_static(1, 2, 3)
    with pytest.raises(TypeError):
        native.slice_static(0, "means", 0, 0, 1, 0, 0)
