"""What holds for every operation of the kernels: what it refuses, the shapes it returns, and the gradients it leaves.

Operations are found in the modules of gsbench.kernels, and their tensors follow from their declarations: a new one is
tested without being listed. Where plain numbers give no gradient, `VALUES` has others for an input's name.
"""

import importlib
import pkgutil
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.library import Library, library_of
from gsbench.kernels.operation import EVERY_ROW, MOST_KNOWN, Gradient, Operation, sizes_of
from gsbench.kernels.raster import count_tiles
from gsbench.kernels.slices import slice_static

N, C, WIDTH, HEIGHT = 5, 2, 20, 18
TILES = count_tiles(WIDTH, HEIGHT)
SIZES = {"N": N, "C": C, "K": 3, "sets": C, "D": 3, "rest": 7, "one": 1, "pairs": C * TILES * N}
SIZES |= {"width": WIDTH, "height": HEIGHT, "levels": 2}
OTHER_SIZE = 4  # where a name is neither above nor derived
NUMBERS = {"near": 0.01, "far": 100.0, "waves": 2, "subtracts": False, "conditioned": EVERY_ROW, "refined": EVERY_ROW}
NUMBERS |= {"x": 3, "y": 4, "z": 5, "t": 6}
WITHOUT = {"time": {"waves": 1}}  # numbers that an input left out changes
PLAIN: dict[type, Any] = {int: 1, float: 0.5, bool: True}
VALUES: dict[str, Tensor] = {
    "viewmats": torch.tensor([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]).repeat(C, 1, 1),
    "Ks": torch.tensor([[12.0, 0, 10], [0, 12, 9], [0, 0, 1]]).repeat(C, 1, 1),
    "means2d": torch.tensor([10.0, 9]).repeat(C, N, 1),
    "roots": torch.tensor([0.3, 0.1, 0.3, 0.5]).repeat(C, N, 1),
    "half_sizes": torch.full((C, N, 2), 20.0),
    "offsets": N * torch.arange(C * TILES + 1, dtype=torch.int32),  # each tile has all splats
    "ids": torch.arange(N, dtype=torch.int32).repeat(C * TILES),
    "opacities": torch.full((N,), 0.5),
    "orders": torch.full((N,), 5, dtype=torch.int32),
    "ends": torch.tensor([1, 1, 2, 3], dtype=torch.int32),
}
LAYOUTS: dict[str, Callable[[Tensor], Tensor]] = {
    "one row for all, stride 0": lambda x: x[:1].expand(x.shape),
    "one number a row, stride 0": lambda x: x[..., :1].expand(x.shape),
    "every second row": lambda x: x.repeat_interleave(2, 0)[::2],
    "transposed": lambda x: x.transpose(0, -1).contiguous().transpose(0, -1),
    "negated, as torch notes of an imaginary part": lambda x: torch._neg_view(-x),
}


class Call(NamedTuple):
    """What an operation can be called with."""

    tensors: dict[str, Tensor | None]  # None: left out
    numbers: dict[str, Any]
    shapes: list[tuple[int, ...]]  # of the outputs

    def with_(self, **changes: Any) -> list[Any]:
        return [changes.get(name, x) for name, x in (self.tensors | self.numbers).items()]


def declared() -> list[Operation]:
    modules = [
        importlib.import_module(f"gsbench.kernels.{m.name}")
        for m in pkgutil.iter_modules(kernels.__path__)
        if not m.name.startswith("_") and m.name != "cuda"
    ]
    return list({id(x): x for module in modules for x in vars(module).values() if isinstance(x, Operation)}.values())


def listed_call(count: int) -> Call:
    """A call of `refine`, whose declaration has no inputs: it takes a list of tensors."""
    g, widths, hidden = torch.Generator().manual_seed(0), (3, 1, 7), 64 * 3
    shapes = {f"values{i}": (count, width) for i, width in enumerate(widths)}
    shapes |= {"weight_in": (hidden, 4 + 6), "bias_in": (hidden,)}
    shapes |= {"weight_out": (sum(widths), 64), "bias_out": (sum(widths),), "units": (sum(widths),)}
    shapes |= {"gamma": (6,), "intervals": (count, 2), "time": ()}
    tensors = {name: torch.rand(shape, generator=g) for name, shape in shapes.items()}
    tensors["intervals"][:, 1] += 1
    return Call(tensors, {"refined": EVERY_ROW}, [(count, width) for width in widths])


def call(operation: Operation, count: int = N, without: str | None = None) -> Call:
    """A call of an operation on so many Gaussians; the inputs that are left out together as `without` are."""
    if not operation.inputs:
        return listed_call(count)
    sizes = SIZES | {"N": count}
    numbers = {key: NUMBERS.get(key, sizes.get(key, PLAIN[kind])) for key, kind in operation.numbers.items()}
    numbers |= {key: x for key, x in WITHOUT.get(without or "", {}).items() if key in numbers}
    inputs = {key: x for key, x in operation.inputs.items() if without is None or x.left_out_with != without}
    tensors: dict[str, Tensor] = {}
    for unknown in (None, OTHER_SIZE):  # first what needs no size that is derived from other tensors
        for key, x in inputs.items():
            shape = shape_in(sizes, x.shape, unknown)
            if None not in shape:
                tensors[key] = values(key, shape, x.dtypes[0], count)
        if operation._derive is not None:
            sizes |= operation._derive(tensors, numbers)
    shapes = [tuple(shape_in(sizes, x.shape)) for x in operation.outputs.values()]
    return Call({key: tensors.get(key) for key in operation.inputs}, numbers, shapes)


def shape_in(sizes: dict[str, int], declared: str, unknown: int | None = None) -> list[int | None]:
    """A declared shape with the sizes put in."""
    named = sizes_of(declared.removeprefix("?views").replace("?", ""))  # a call on the CPU has one view
    return [size if isinstance(size, int) else sizes.get(size, unknown) for size in named]


def values(key: str, shape: list[int], dtype: torch.dtype, count: int) -> Tensor:
    """The numbers of an input: its own, or any."""
    if key in VALUES:
        known = VALUES[key].expand(*shape[: len(shape) - VALUES[key].dim()], *VALUES[key].shape)
        for dim, size in enumerate(shape):  # repeated where more are asked for
            known = known.index_select(dim, torch.arange(size) % known.shape[dim])
        return (
            known if count or dtype is torch.float32 else known.zero_()
        )  # no number of a Gaussian where there are none
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(key))).to(dtype)


OPERATIONS = pytest.mark.parametrize("operation", declared(), ids=lambda operation: operation.name)


def run(operation: Operation, at: Call) -> tuple[list[Tensor], dict[str, Tensor | None]]:
    """The outputs of a call, and the gradients of a weighted sum of them by all that has one, from autograd."""
    tensors = [torch.empty(0) if x is None else x.detach() for x in at.tensors.values()]
    for x, has_gradient in zip(tensors, operation.differentiable(tensors), strict=True):
        x.requires_grad_(has_gradient and x.dtype is torch.float32)
    there = {name: x for name, x in zip(at.tensors, tensors, strict=True) if at.tensors[name] is not None}
    outputs = operation(*at.with_(**there))
    carried = [x for x, carries in zip(outputs, operation.carries_gradient(outputs), strict=True) if carries]
    g = torch.Generator().manual_seed(1)
    sum((x * torch.rand(x.shape, generator=g)).sum() for x in carried).backward()
    return outputs, {name: x.grad for name, x in there.items() if x.requires_grad}


@OPERATIONS
def test_shapes_and_gradients(operation):
    """Catches outputs of other shapes than declared, and an input whose gradient is lost on the way to autograd."""
    at = call(operation)
    outputs, gradients = run(operation, at)
    assert [tuple(x.shape) for x in outputs] == at.shapes
    assert all(x.isfinite().all() for x in outputs)
    assert gradients
    for name, gradient in gradients.items():
        assert gradient is not None, name
        assert gradient.shape == at.tensors[name].shape
        assert gradient.isfinite().all(), name
        assert gradient.any(), f"{name}: no gradient; where that is due to its numbers, give it others in VALUES"


@OPERATIONS
@pytest.mark.usefixtures("threads")
def test_threads_and_wider_vectors_change_no_bit(operation):
    """Catches rows that two threads share or none computes, another order of a sum; a product that only one of v3 and
    v4 fuses with a sum, an approximate instruction."""
    at = call(operation, N if "ids" in operation.inputs else 1100 + 5)  # some whole vectors, and a rest; `ids` are of N
    levels, results = kernels.native().instruction_sets(), []
    try:
        for level in [level for level in levels if level != "v2"] or levels:
            kernels.use_instruction_set(level)
            for threads in (1, 2, 3):
                torch.set_num_threads(threads)
                results.append(run(operation, at))
    finally:
        kernels.use_instruction_set(levels[-1])
    outputs, gradients = results[0]
    for other, other_gradients in results[1:]:
        assert all(torch.equal(x, y) for x, y in zip(outputs, other, strict=True))
        assert [name for name, x in gradients.items() if not torch.equal(x, other_gradients[name])] == []


@OPERATIONS
def test_memory_of_any_layout(operation):
    """Catches memory read as it does not lie, a gradient that is added up in the memory that the rows of a leaf share,
    or one that is written in another order: weights whose columns were taken for rows gave wrong results in silence."""
    at = call(operation)
    for name, x in at.tensors.items():
        for layout in LAYOUTS if x is not None and x.is_floating_point() and x.dim() else ():
            laid_out = LAYOUTS[layout](x)
            plain = laid_out.resolve_neg().contiguous().clone()
            results = [run(operation, at._replace(tensors=at.tensors | {name: y})) for y in (laid_out, plain)]
            torch.testing.assert_close(*results)


@OPERATIONS
def test_no_gaussians(operation):
    """Catches a loop that runs once over nothing, there and back."""
    at = call(operation, 0)
    outputs, gradients = run(operation, at)
    assert [tuple(x.shape) for x in outputs] == at.shapes
    assert all(g is not None and g.isfinite().all() for g in gradients.values())


@OPERATIONS
def test_what_is_left_out_together(operation):
    """Catches a null address in a kernel, which ended the process by a signal: a part of a group is refused."""
    groups: dict[str, list[str]] = {}
    for name, x in operation.inputs.items():
        groups.setdefault(x.left_out_with or "", []).append(name)
    for group in groups.keys() - {""}:
        at = call(operation, without=group)
        outputs, gradients = run(operation, at)
        assert [tuple(x.shape) for x in outputs] == at.shapes
        assert not gradients.keys() & set(groups[group])
        for name in groups[group] if len(groups[group]) > 1 else ():
            for nothing in (None, torch.empty(0)):
                with pytest.raises(InputError, match=rf"^{operation.name}: expected all of .*\b{name}\b.*, or none"):
                    operation(*call(operation).with_(**{name: nothing}))


@OPERATIONS
def test_wrong_arguments_are_refused(operation):
    """Catches arrays that a kernel would read past their end or as other numbers, and a message without a name."""
    at = call(operation)
    for name, x in at.tensors.items():
        other = torch.int64 if x.dtype is torch.int32 else torch.float64
        free = name in operation.inputs and has_any_length(operation, name)
        wrong = [x.to(other), x[..., None], x.to("meta"), "a tensor"]
        wrong += [torch.cat([x, x])] if x.dim() and not free else []
        wrong += [x.to_sparse()] if x.dim() else []
        for bad in wrong:
            with pytest.raises(InputError, match=f"^{operation.name}: "):
                operation(*at.with_(**{name: bad}))
    for name in at.numbers:
        with pytest.raises(InputError, match=f"^{operation.name}: "):
            operation(*at.with_(**{name: "a number"}))
    for name, x in operation.inputs.items():
        if x.gradient is Gradient.REFUSED and x.dtypes[0] is torch.float32:
            with pytest.raises(InputError, match=f"^{operation.name} has no gradient by {name}: "):
                operation(*at.with_(**{name: at.tensors[name].clone().requires_grad_()}))


def has_any_length(operation: Operation, name: str) -> bool:
    """Whether the first dimension of an input is one of no other input."""
    first, *_ = sizes_of(operation.inputs[name].shape) or (None,)
    others = {size for key, x in operation.inputs.items() if key != name for size in sizes_of(x.shape)}
    return operation.inputs[name].is_list or (isinstance(first, str) and first.lstrip("?") not in others)


@pytest.mark.parametrize("operation", [x for x in declared() if x.adds], ids=lambda operation: operation.name)
def test_what_is_added_is_added(operation):
    """Catches a backward kernel that overwrites the gradients of a batch's other views."""
    at = call(operation)
    tensors, numbers = list(at.tensors.values()), list(at.numbers.values())
    outputs, slots = operation.run(tensors, numbers)
    by_outputs, wanted = [torch.ones_like(x) for x in outputs], [True] * len(tensors)
    alone = operation.backward(tensors, slots, outputs, by_outputs, wanted, {})
    sums = {i: torch.full_like(tensors[i], 3.0) for i in operation.adds}
    both = operation.backward(tensors, slots, outputs, by_outputs, wanted, sums)
    for i in operation.adds:
        assert both[i] is sums[i]
        assert alone[i].any()
        torch.testing.assert_close(both[i], alone[i] + 3)


def test_torch_compile_leaves_operations_to_python():
    """Catches an operation whose addresses torch.compile traces, or whose gradient it loses."""

    def loss(scales: Tensor) -> Tensor:
        factors, opacities = slice_static(scales.sin(), torch.ones(N, 4), torch.zeros(N))
        return (factors.square().sum((1, 2)) * opacities).cos().sum()

    scales = torch.rand(N, 3).requires_grad_()
    compiled = torch.compile(loss, backend="eager")(scales)
    assert torch.equal(*(torch.autograd.grad(x, scales)[0] for x in (compiled, loss(scales))))


# ---- what is declared


@OPERATIONS
def test_declaration_and_kernel_name_the_same(operation):
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


def test_every_kernel_is_declared():
    """Catches a kernel that no operation calls any more."""
    called = {operation.name for operation in declared()}
    without_gradient = {"adam_all", "flag_values", "flag_arrays", "exact_splats", "exact_image"}
    without_gradient |= {"count_tiles", "fill_tiles", "zero_arrays"}
    assert {name.removesuffix("_backward") for name in kernels.native().SIGNATURES} == called | without_gradient


def test_kernels_of_another_source_are_refused():
    """Catches a build older than its source: its kernels would ignore arguments that they do not know."""
    older = dict(kernels.native().SIGNATURES) | {"slice_free_time": (("INPUTS", "N, threads"),)}
    with pytest.raises(InputError, match="slice_free_time is not of this source"):
        Library(SimpleNamespace(SIGNATURES=older))


def test_a_message_says_what_was_expected_and_what_came():
    """Catches a refusal that names no shape."""
    with pytest.raises(InputError, match=r"expected quats of shape \[4, 4\], got \[5, 4\]"):
        slice_static(torch.zeros(4, 3), torch.zeros(5, 4), torch.zeros(4))
    with pytest.raises(InputError, match="scales: expected float32, got int64"):
        slice_static(torch.zeros(4, 3).long(), torch.zeros(4, 4), torch.zeros(4))


def test_known_calls_are_not_matched_again(monkeypatch):
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


def test_the_extension_counts_and_types_its_values():
    """Catches a call that shifts every field by one: the last door looks at number and kind."""
    native = kernels.native()
    with pytest.raises(TypeError, match="expected 8 values"):
        native.slice_static(1, 2, 3)
    with pytest.raises(TypeError):
        native.slice_static(0, "means", 0, 0, 1, 0, 0)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("sizes", [(0, 1, 7), (5, (1 << 20) + 3)])
def test_zeroed_arrays_are_zero_and_their_neighbours_are_not(sizes):
    """Catches the ends of arrays, which begin anywhere; zeros of large ones are written past the cache."""
    around = [torch.ones(1 + n + 2) for n in sizes]
    library_of("cpu").zero([x[1:-2] for x in around])
    for x in around:
        assert not x[1:-2].any()
        assert x[0] == 1
        assert (x[-2:] == 1).all()
