"""What holds for every operation of the kernels: what it refuses, the shapes it returns, and the gradients it leaves.

Operations are found in the modules of gsbench.kernels, and their tensors follow from their declarations: a new one is
tested without being listed. Where plain numbers give no gradient, `VALUES` has others for an input's name.
"""

import importlib
import pkgutil
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensorMode

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels.operation import EVERY_ROW, Gradient, Operation, sizes_of
from gsbench.kernels.raster import count_tiles

N, C, WIDTH, HEIGHT = 5, 2, 20, 18
TILES = count_tiles(WIDTH, HEIGHT)
SIZES = {"N": N, "C": C, "sets": C, "D": 3, "rest": 7, "one": 1, "width": WIDTH, "height": HEIGHT,
         "pairs": C * TILES * N}  # fmt: skip
OTHER_SIZE = 4  # where a name is neither above nor derived
NUMBERS = {"near": 0.01, "far": 100.0, "waves": 2, "subtracts": False, "conditioned": EVERY_ROW, "refined": EVERY_ROW}
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
}


class Call(NamedTuple):
    """What an operation can be called with."""

    tensors: dict[str, Tensor | None]  # None: left out
    numbers: dict[str, Any]
    shapes: list[tuple[int, ...]]  # of the outputs

    def with_(self, **changes: Any) -> list[Any]:
        """The arguments with some of them changed."""
        return [changes.get(name, x) for name, x in (self.tensors | self.numbers).items()]


def declared() -> list[Operation]:
    """Every operation of gsbench.kernels."""
    modules = [importlib.import_module(f"gsbench.kernels.{m.name}") for m in pkgutil.iter_modules(kernels.__path__)
               if not m.name.startswith("_") and m.name != "cuda"]  # fmt: skip
    return list({id(x): x for module in modules for x in vars(module).values() if isinstance(x, Operation)}.values())


def listed_call(count: int) -> Call:
    """A call of `refine`, whose declaration has no inputs: it takes a list of tensors."""
    g, widths, hidden = torch.Generator().manual_seed(0), (3, 1, 7), 64 * 3
    shapes = {"values0": (count, 3), "values1": (count, 1), "values2": (count, 7), "weight_in": (hidden, 4 + 6),
              "bias_in": (hidden,), "weight_out": (sum(widths), 64), "bias_out": (sum(widths),),
              "units": (sum(widths),), "gamma": (6,), "intervals": (count, 2), "time": ()}  # fmt: skip
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
    named = sizes_of(declared.replace("?", ""))
    return [size if isinstance(size, int) else sizes.get(size, unknown) for size in named]


def values(key: str, shape: list[int], dtype: torch.dtype, count: int) -> Tensor:
    """The numbers of an input: its own, or any."""
    if key in VALUES:
        known = VALUES[key]
        for dim, size in enumerate(shape):  # repeated where more are asked for
            known = known.index_select(dim, torch.arange(size) % known.shape[dim])
        return (
            known if count or dtype is torch.float32 else known.zero_()
        )  # no number of a Gaussian where there are none
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(key))).to(dtype)


OPERATIONS = pytest.mark.parametrize("operation", declared(), ids=lambda operation: operation.name)


def run(operation: Operation, at: Call) -> tuple[list[Tensor], dict[str, Tensor | None]]:
    """The outputs of a call, and the gradients of a weighted sum of them by all that has one, from autograd."""
    tensors = [torch.empty(0) if x is None else x.clone() for x in at.tensors.values()]
    for x, has_gradient in zip(tensors, operation.differentiable(tensors), strict=True):
        x.requires_grad_(has_gradient and x.dtype is torch.float32)
    there = {name: x for name, x in zip(at.tensors, tensors, strict=True) if at.tensors[name] is not None}
    outputs = operation(*at.with_(**there))
    carried = [x for x, carries in zip(outputs, operation.carries_gradient(outputs), strict=True) if carries]
    g = torch.Generator().manual_seed(1)
    sum((x * torch.rand(x.shape, generator=g)).sum() for x in carried).backward()
    return outputs, {name: x.grad for name, x in there.items() if x.requires_grad}


@OPERATIONS
def test_shapes_and_gradients(operation: Operation) -> None:
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
def test_v3_and_v4_have_the_same_bits(operation: Operation) -> None:
    """Catches a product that only one build fuses with a sum, another order of a sum, an approximate instruction."""
    levels = kernels.native().instruction_sets()
    if "v4" not in levels or "v3" not in levels:
        pytest.skip("needs a processor with AVX-512, and the kernels of v3 and v4: make test LEVELS=all")
    many = 3 * 16 + 5  # some whole vectors, and a rest
    at, results = call(operation, N if "ids" in operation.inputs else many), []  # `ids` are of N Gaussians
    try:
        for level in ("v3", "v4"):
            kernels.use_instruction_set(level)
            results.append(run(operation, at))
    finally:
        kernels.use_instruction_set(levels[-1])
    (outputs, gradients), (other_outputs, other_gradients) = results
    assert all(torch.equal(x, y) for x, y in zip(outputs, other_outputs, strict=True))
    assert [name for name, x in gradients.items() if not torch.equal(x, other_gradients[name])] == []


@OPERATIONS
def test_no_gaussians(operation: Operation) -> None:
    """Catches a loop that runs once over nothing, there and back."""
    at = call(operation, 0)
    outputs, gradients = run(operation, at)
    assert [tuple(x.shape) for x in outputs] == at.shapes
    assert all(g is not None and g.isfinite().all() for g in gradients.values())


@OPERATIONS
def test_what_is_left_out_together(operation: Operation) -> None:
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
def test_wrong_arguments_are_refused(operation: Operation) -> None:
    """Catches arrays that a kernel would read past their end or as other numbers, and a message without a name."""
    at = call(operation)
    for name, x in at.tensors.items():
        other = torch.int64 if x.dtype is torch.int32 else torch.float64
        free = name in operation.inputs and operation.inputs[name].is_list  # of any length
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


@pytest.mark.parametrize("operation", [x for x in declared() if x.adds], ids=lambda operation: operation.name)
def test_what_is_added_is_added(operation: Operation) -> None:
    """Catches a backward kernel that overwrites the gradients of a batch's other views."""
    at = call(operation)
    tensors, numbers = list(at.tensors.values()), list(at.numbers.values())
    outputs, slots = operation.run(tensors, numbers)
    by_outputs, wanted = [torch.ones_like(x) for x in outputs], [True] * len(tensors)
    alone = operation.backward(tensors, slots, outputs, by_outputs, wanted)
    sums = {i: torch.full_like(tensors[i], 3.0) for i in operation.adds}
    both = operation.backward(tensors, slots, outputs, by_outputs, wanted, sums)
    for i in operation.adds:
        assert both[i] is sums[i]
        assert alone[i].any()
        torch.testing.assert_close(both[i], alone[i] + 3)


@OPERATIONS
def test_torch_compile_is_told_the_shapes(operation: Operation) -> None:
    """Catches a fake whose shapes are not those of the outputs and gradients: torch.compile would allocate others."""
    at = call(operation)
    with FakeTensorMode() as mode:
        fakes = [mode.from_tensor(x) for x in at.tensors.values()]
        outputs = getattr(torch.ops.gsbench, operation.name)(fakes, *at.numbers.values())
        assert [tuple(x.shape) for x in outputs] == at.shapes
        assert [x.shape for x in operation.fake_backward(fakes)] == [x.shape for x in fakes]
