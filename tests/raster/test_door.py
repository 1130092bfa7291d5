"""What `rasterize` refuses: every fault is an InputError of one line that names the argument."""

import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch
from cases import case
from torch import Tensor

from gsbench import kernels
from gsbench.errors import InputError
from gsbench.kernels import backends, cuda
from gsbench.kernels.backends import AUTO, REFERENCE, resolve
from gsbench.process import memory
from gsbench.raster import native, rasterize

TENSORS = {"means": (40, 3), "factors": (40, 3, 3), "opacities": (40,), "colors": (40, 3),
           "viewmats": (1, 4, 4), "Ks": (1, 3, 3), "background": (3,)}  # fmt: skip


def refused(changes: dict[str, Any], name: str) -> None:
    """Assert that the scene with `changes` raises an InputError of one line that begins with or states `name`."""
    arguments = {**case("tall"), "background": torch.zeros(3, dtype=torch.float64), "backend": "reference"}
    with pytest.raises(InputError) as error:
        rasterize(**arguments | changes)
    assert name in str(error.value)
    assert "\n" not in str(error.value)


def test_the_scene_itself_is_accepted() -> None:
    """Catches a scene that is refused for another reason than the one tested."""
    arguments = {**case("tall"), "background": torch.zeros(3, dtype=torch.float64)}
    assert {k: tuple(arguments[k].shape) for k in TENSORS} == TENSORS
    rasterize(**arguments, backend="reference")


@pytest.mark.parametrize("name", TENSORS)
def test_shapes(name: str) -> None:
    """Catches a shape that is let in and fails in the depths, or draws nonsense by broadcasting."""
    wrong = [(), (0,), (7,), (*TENSORS[name], 1), (1, *TENSORS[name]), (*TENSORS[name][:-1], 2)]
    # Colours may have any number of channels (background then does not fit), one set a camera.
    for shape in wrong:
        if name == "colors" and shape in {(1, 40, 3), (40, 2)}:
            continue
        refused({name: torch.zeros(shape, dtype=torch.float64)}, name)
    refused({name: [[0.0]]}, name)


def test_a_background_that_is_no_tensor_is_none() -> None:
    """Catches a list that is let in where the same scene was drawn without a background before."""
    rasterize(**case("tall"), background=None, backend="reference")
    refused({"background": [0.0, 0.0, 0.0]}, "background: expected a tensor, got list")


def test_exponents_of_beta_profiles() -> None:
    """Catches exponents that are let in and draw NaN, or that broadcast over the Gaussians."""
    good = torch.ones(40).double()
    refused({"shapes": 2.0}, "shapes: expected a tensor, got float")
    refused({"shapes": good[:1]}, "shapes: expected shape [40], got [1]")
    refused({"shapes": good[:, None]}, "shapes: expected shape [40], got [40, 1]")
    refused({"shapes": good.float()}, "shapes: expected torch.float64 as means are, got torch.float32")
    refused({"shapes": good.int()}, "shapes: expected float32 or float64, got int32")
    refused({"shapes": good.to("meta")}, "shapes: expected a tensor with values")
    for bad, said in (
        (0.0, "above 0, got 0.0"),
        (-1.0, "above 0, got -1.0"),
        (torch.nan, "finite"),
        (torch.inf, "finite"),
    ):
        refused(
            {"shapes": torch.where(torch.arange(40) == 7, bad, good)},
            f"shapes: expected {'exponents ' * (bad <= 0)}{said}",
        )


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_no_shapes_are_gaussians(backend: str) -> None:
    """Catches an image that changes by a bit where shapes are None."""
    arguments = case("tall", torch.float32) | {"backend": backend}
    assert torch.equal(rasterize(**arguments).image, rasterize(**arguments, shapes=None).image)


def test_gaussians_are_counted_for_every_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches more splats than int32 numbers because there are several cameras: 40 Gaussians in 2 are 80."""
    one = {name: x.float() if isinstance(x, Tensor) else x for name, x in case("tall").items()}
    two = one | {"viewmats": one["viewmats"].repeat(2, 1, 1), "Ks": one["Ks"].repeat(2, 1, 1)}
    monkeypatch.setattr(native, "MAX_PAIRS", 79)
    with pytest.raises(InputError, match="at most 79 Gaussians times cameras, got 80"):
        rasterize(**two, backend="cpu")


def test_rows_that_differ() -> None:
    """Catches numbers of Gaussians, cameras or channels that do not agree."""
    refused({"opacities": torch.zeros(39).double()}, "opacities: expected shape [40], got [39]")
    refused({"colors": torch.zeros(2, 40, 3).double()}, "colors: expected shape [1, 40, 3], got [2, 40, 3]")
    refused({"colors": torch.zeros(40, 2).double()}, "background: expected shape [2], got [3]")
    refused({"Ks": torch.eye(3).double().repeat(2, 1, 1)}, "Ks: expected shape [1, 3, 3], got [2, 3, 3]")
    refused({"colors": torch.zeros(40, 0).double(), "background": None}, "colors")
    refused({"viewmats": torch.zeros(0, 4, 4).double(), "Ks": torch.zeros(0, 3, 3).double()}, "viewmats")


@pytest.mark.parametrize("name", TENSORS)
def test_types_and_places(name: str) -> None:
    """Catches mixed precision, integers, and a tensor on another device."""
    value = {**case("tall"), "background": torch.zeros(3)}[name]
    wrong_type = "opacities" if name == "means" else name  # the others are held to the means
    refused({name: value.float()} if name != "means" else {"opacities": value[:, 0].float()}, wrong_type)
    refused({name: value.int()}, name if name != "means" else "expected float32 or float64")
    if name != "means":
        refused({name: torch.zeros(TENSORS[name], dtype=torch.float64, device="meta")}, name)


@pytest.mark.parametrize("backend", ["reference", "cpu", "auto"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        (Tensor.half, "got float16: convert it by .to(torch.float32)"),
        (Tensor.bfloat16, "got bfloat16"),
        (lambda x: x.to(torch.complex64), "got complex64"),
        (Tensor.long, "got int64"),
        (Tensor.to_sparse, "expected a dense tensor, got a sparse_coo one"),
        (Tensor.numpy, "expected a tensor, got ndarray"),
        (lambda x: x.to("meta"), "on the meta device"),
    ],
)
def test_kinds_of_tensors(change: Callable[[Tensor], Any], said: str, backend: str) -> None:
    """Catches half precision, sparse and complex tensors that fail in the depths or are drawn in too few digits."""
    for name in TENSORS:
        arguments = case("tall", torch.float32) | {"background": torch.zeros(3)}
        refused(arguments | {name: change(arguments[name]), "backend": backend}, f"{name}: ")
        refused(arguments | {name: change(arguments[name]), "backend": backend}, said)


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_memory_is_asked_for(backend: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an image, or colours of stride 0, that take more memory than there is and end the process."""
    monkeypatch.setattr(memory, "available", lambda: 24 << 30)
    refused({"width": 10**7, "height": 10**7, "backend": backend}, "GiB are available")
    many = {name: torch.zeros(1, *shape[1:]).expand(10**8, *shape[1:]) for name, shape in list(TENSORS.items())[:4]}
    arguments = case("tall", torch.float32) | {"background": None, "backend": backend}
    refused(arguments | many, "with 100000000 Gaussians need" if backend == "reference" else "got 100000000")


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", TENSORS)
def test_values_that_are_not_finite(name: str, bad: float) -> None:
    """Catches NaN and infinities, which would be drawn as nothing and train as NaN."""
    value = {**case("tall"), "background": torch.zeros(3, dtype=torch.float64)}[name].clone()
    value.view(-1)[-1] = bad
    refused({name: value}, f"{name}: expected finite values")


def test_large_sums_are_finite() -> None:
    """Catches a check of the sum alone: finite values whose sum overflows are accepted."""
    arguments = case("tall", torch.float32)
    arguments["colors"] = torch.full((40, 3), 3e38)
    rasterize(**arguments, backend="reference")


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"width": 0}, "width=0"),
        ({"height": -3}, "height=-3"),
        ({"width": 8.5}, "width=8.5"),
        ({"width": "8"}, "width='8'"),
        ({"width": True}, "width=True"),
        ({"near": None}, "near=None"),
        ({"antialias": "no"}, "antialias"),
        ({"backend": 3}, "backend"),
        ({"near": 0.0}, "near=0.0"),
        ({"near": -1.0}, "near=-1.0"),
        ({"near": 2.0, "far": 2.0}, "far=2.0"),
        ({"near": float("nan")}, "near=nan"),
        ({"far": float("nan")}, "far=nan"),
        ({"eps2d": -0.1}, "eps2d=-0.1"),
        ({"eps2d": float("nan")}, "eps2d=nan"),
        ({"eps2d": float("inf")}, "eps2d=inf"),
        ({"opacities": torch.full((40,), 1.5).double()}, "opacities: expected values in [0, 1]"),
        ({"opacities": torch.full((40,), -0.1).double()}, "opacities: expected values in [0, 1]"),
        ({"Ks": torch.diag(torch.tensor([-5.0, 5.0, 1.0])).double()[None]}, "Ks: expected positive focal lengths"),
        ({"Ks": torch.diag(torch.tensor([5.0, 0.0, 1.0])).double()[None]}, "Ks: expected positive focal lengths"),
        ({"Ks": torch.tensor([[[5.0, 0.1, 8], [0, 5, 6], [0, 0, 1]]]).double()}, "skew is not drawn"),
        (
            {"Ks": torch.tensor([[[5.0, 0, 8], [0, 5, 6], [0, 0, 2]]]).double()},
            "Ks: expected [fx 0 cx; 0 fy cy; 0 0 1]",
        ),
        ({"backend": "refrence"}, "Did you mean 'reference'?"),
        ({"backend": ""}, "raster backend ''"),
    ],
)
def test_values(changes: dict[str, Any], name: str) -> None:
    """Catches a number out of its range that would draw an empty or a wrong picture without a word."""
    refused(changes, name)


def test_auto_says_once_that_the_gpu_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches kernels built for a GPU that is missing, or a GPU without its kernels, passed over in silence."""
    backends._warn_once.cache_clear()
    monkeypatch.setattr(cuda, "available", lambda: False)
    monkeypatch.setattr(cuda, "built", lambda: True)
    with pytest.warns(UserWarning, match="no CUDA device was found"):
        fallback = resolve("auto", "cpu")
    assert fallback.name in ("cpu", "reference")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve("auto", "cpu") == fallback
    monkeypatch.setattr(cuda, "built", lambda: False)
    with pytest.warns(UserWarning, match="the CUDA kernels are not built"):
        assert resolve("auto", "cuda") is REFERENCE
    backends._warn_once.cache_clear()


def test_auto_says_once_that_there_are_no_kernels(monkeypatch: pytest.MonkeyPatch) -> None:
    """Catches an installation without a compiler that is slow without a word, or says so at every picture."""
    backends._warn_once.cache_clear()
    monkeypatch.setattr(kernels, "available", lambda: False)
    monkeypatch.setattr(cuda, "built", lambda: False)
    with pytest.warns(UserWarning, match="kernels are not built .* is slow; reinstall with a C\\+\\+20 compiler"):
        assert resolve("auto", "cpu") is REFERENCE
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve("auto", "cpu") is REFERENCE
    backends._warn_once.cache_clear()


@pytest.mark.parametrize(
    ("built", "device", "said"),
    [(False, False, "it is not built here"), (True, False, "no CUDA device was found"),
     (True, True, "does not render on device 'cpu': use device=cuda")],
)  # fmt: skip
def test_cuda_without_its_kernels_its_gpu_or_tensors_on_it(
    built: bool, device: bool, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Catches a run that asks for the GPU and finds out in the depths, or in the first picture, that it cannot."""
    monkeypatch.setattr(cuda, "built", lambda: built)
    monkeypatch.setattr(cuda, "available", lambda: device)
    refused({"backend": "cuda"}, said)
    with pytest.raises(InputError, match="raster backend 'cuda'"):
        resolve("cuda", "cpu")


def test_auto_falls_back_to_the_reference() -> None:
    """Catches `auto` choosing a backend that cannot serve the tensors: the native one has no float64."""
    assert not AUTO.serves(torch.zeros(1, dtype=torch.float64))
    assert not REFERENCE.serves(torch.zeros(1))
