"""The declaration of operations: what is refused at the door, and that kernels name the same things."""

import importlib
import pkgutil

import pytest
import torch

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.colors import show_colors
from gsbench.kernels.library import library_of
from gsbench.kernels.operation import MOST_KNOWN, Operation
from gsbench.kernels.slices import _static, slice_rotated, slice_static


def declared() -> list[Operation]:
    """Every operation of gsbench.kernels."""
    modules = [importlib.import_module(f"gsbench.kernels.{m.name}") for m in pkgutil.iter_modules(kernels.__path__)
               if not m.name.startswith("_") and m.name != "cuda"]  # fmt: skip
    return [x for module in modules for x in vars(module).values() if isinstance(x, Operation)]


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
    for name, own in zip(operation.inputs, operation.differentiable([]) if operation.inputs else (), strict=True):
        assert library.takes(f"{operation.name}_backward", f"grad.{name}") == own, name


def test_every_kernel_is_declared() -> None:
    """Catches a kernel that no operation calls any more."""
    called = {operation.name for operation in declared()}
    others = {"adam", "adam_all", "flag_values", "count_tiles", "fill_tiles"}  # without a gradient
    assert {name.removesuffix("_backward") for name in kernels.native().SIGNATURES} == called | others


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ((torch.zeros(4, 3), torch.zeros(5, 4), torch.zeros(4)), r"expected quats of shape \[4, 4\], got \[5, 4\]"),
        ((torch.zeros(4, 3), torch.zeros(4, 4), torch.zeros(4, 1)), r"expected opacities of shape \[4\], got \[4, 1\]"),
        ((torch.zeros(4, 3), torch.zeros(4, 4).double(), torch.zeros(4)), "quats: expected float32"),
        ((torch.zeros(4, 3).long(), torch.zeros(4, 4), torch.zeros(4)), "scales: expected float32"),
    ],
)
def test_what_does_not_fit_is_refused(given: tuple[torch.Tensor, ...], said: str) -> None:
    """Catches arrays that a kernel would read past their end."""
    with pytest.raises(InputError, match=said):
        slice_static(*given)


def test_coefficients_are_whole_harmonics_of_every_wave() -> None:
    """Catches coefficients that are no multiple of the waves: the kernel would read one wave's as another's."""
    N = 4
    given = torch.zeros(N, 1, 3), torch.zeros(N, 6, 3), torch.zeros(N, 3), torch.ones(N), torch.zeros(3)
    with pytest.raises(InputError, match="waves=2 and 7 coefficients"):
        show_colors(*given, 0, torch.zeros(N, 1), torch.tensor(0.0), 2)


def test_known_calls_are_not_matched_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches models that are rendered in turns and pay for each other's checks (0.1 ms a frame), and sizes of
    Gaussians that are kept for ever."""
    matched: list[int] = []
    own = _static._match
    monkeypatch.setattr(_static, "_match", lambda tensors, numbers: (matched.append(1), own(tensors, numbers))[1])
    for _ in range(3):
        for N in (1003, 1005):
            factors, opacities = slice_static(torch.zeros(N, 3), torch.ones(N, 4), torch.zeros(N))
            assert factors.shape == (N, 3, 3)
            assert opacities.shape == (N,)
    assert len(matched) <= 2
    for N in range(2 * MOST_KNOWN):
        slice_static(torch.zeros(N, 3), torch.ones(N, 4), torch.zeros(N))
    assert len(_static._known) <= MOST_KNOWN


def test_columns_are_put_in_rows() -> None:
    """Catches a kernel that is given the address of a transposed tensor."""
    g = torch.Generator().manual_seed(0)
    scales, quats, opacities = (torch.randn(n, 4, generator=g) for n in (3, 4, 1))
    columns = slice_static(scales.mT, quats.mT, opacities[0])
    rows = slice_static(scales.mT.contiguous(), quats.mT.contiguous(), opacities[0])
    assert all(torch.equal(a, b) for a, b in zip(columns, rows, strict=True))


def test_no_gradient_is_promised_where_there_is_none() -> None:
    """Catches a gradient by time that would be zero without a word."""
    x = torch.zeros(2, 4)
    with pytest.raises(InputError, match="slice_rotated has no gradient by time"):
        slice_rotated(x[:, :3], x[:, :1], x, x + 1, x + 1, x[:, 0], torch.ones(()),
                        torch.zeros((), requires_grad=True), torch.zeros(()))  # fmt: skip


def test_the_extension_counts_and_types_its_values() -> None:
    """Catches a call that shifts every field by one: the last door looks at number and kind."""
    native = kernels.native()
    with pytest.raises(TypeError, match="expected 7 values"):
        native.slice_static(1, 2, 3)
    with pytest.raises(TypeError):
        native.slice_static(0, "means", 0, 0, 1, 0, 0)
