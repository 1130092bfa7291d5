"""A training has the same bits on processors with and without AVX-512, and of another vendor."""

from typing import Any

import pytest
import torch
from forked import ended
from interrupted import assert_same_bits
from test_checkpoint import comparable_state
from tiny_run import command, environment
from tiny_training import NARROW, compose, moving_square
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from gsbench import kernels
from gsbench.run import fitting
from gsbench.run.setup import build

# What each library chooses by itself on a processor without AVX-512: the kernels of gsbench, torch, its MKL, and numpy
# with its OpenBLAS.
WITHOUT_AVX512 = {
    "GSBENCH_ISA": "v3",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    "OPENBLAS_CORETYPE": "Zen",
}
SLOW = (
    *("3dgs", "4dgs", "6dgs", "7dgs_noagr", "auto", "dbs", "deformable_narrow", "dgs", "ex4dgs", "freetime"),
    *("freetime_plus", "hexplane", "ndgs", "scgs", "sharptime", "stg", "stg_full", "ubs"),
)


@pytest.mark.parametrize("model", ["7dgs", *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_a_training_has_the_same_bits_without_avx512(model, tmp_path):
    """Catches an operation of a training, in the kernels or in a library, whose bits depend on the processor."""
    if "v4" not in kernels.native().instruction_sets() or "v3" not in kernels.native().instruction_sets():
        pytest.skip("needs a processor with AVX-512, and the kernels of v3 and v4: make test LEVELS=all")
    wanted = ["+exp=mini", "scene=suzanne", f"model={model}", "train.iterations=200"]
    wanted += NARROW.get(model, [])  # a field of the authors' size takes minutes
    plain = {name: value for name, value in environment().items() if name not in WITHOUT_AVX512}
    for folder, more in (("with", {}), ("without", WITHOUT_AVX512)):
        done = ended(*command(*wanted, f"results={tmp_path / folder}"), env=plain | more)
        assert done.returncode == 0, done.stderr
    assert_same_bits(comparable_state(tmp_path / "with"), comparable_state(tmp_path / "without"))


# What torch leaves to MKL, which chooses its code by the vendor of the processor.
OF_MKL = (
    *("acos", "asin", "atan", "cos", "erf", "erfc", "exp", "expm1", "log", "log10", "log1p", "logit", "sin", "sqrt"),
    *("tan", "tanh"),
)
# What a training does only if an option asks for it.
OPTIONS = {
    "3dgs": ("train.densify.kind=mcmc", "train.penalties.opacity.weight=0.01", "train.penalties.size.weight=0.01"),
    "4dgs": (
        *("train.densify.kind=multiview", "train.densify.thin_to=0.8"),
        *("train.coarse=[[2,20]]", "optim=sparse_adam", "raster.antialias=true", "train.camera_colors=true"),
    ),
}


class OtherProcessor(TorchDispatchMode):
    """Change the last bit of every third float32 result of the functions that torch leaves to MKL."""

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        if function.overloadpacket.__name__.rstrip("_") in OF_MKL and result.dtype == torch.float32:
            third = torch.arange(result.numel()).reshape(result.shape) % 3 == 0
            result.copy_(torch.where(third, torch.nextafter(result, torch.tensor(torch.inf)), result))
        return result


@pytest.mark.parametrize(
    ("model", "options"),
    [*OPTIONS.items(), *((name, ()) for name in ("7dgs", *SLOW) if name not in ("7dgs_noagr", "auto"))],
)
def test_a_training_does_not_depend_on_the_last_bits_of_mkl(model, options):
    """Catches a float32 function in a training that has other bits on AMD than on Intel, as exp in splits had."""

    def trained() -> list[Tensor]:
        config = compose(model, 60, "train.densify.reset_every=100000", *options)
        trainer = fitting.trainer_of(build(config), moving_square(), config, None)
        trainer.run(lambda _: None, model)
        return [parameter.detach() for parameter in trainer.model.parameters()]

    here = trained()
    with OtherProcessor():
        assert not torch.equal(torch.ones(7).exp(), torch.full((7,), torch.e)), "nothing is changed"
        there = trained()
    assert len(here[0]) > 40, "if no Gaussian is split, nothing is tested here"
    assert all(torch.equal(a, b) for a, b in zip(here, there, strict=True))
