"""What `rasterize` refuses: every fault is an InputError of one line that names the argument."""

import warnings
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

TENSORS = {
    "means": (40, 3),
    "factors": (40, 3, 3),
    "opacities": (40,),
    "colors": (40, 3),
    "viewmats": (1, 4, 4),
    "Ks": (1, 3, 3),
    "background": (3,),
}
NAN, INF = float("nan"), float("inf")
SHAPES = torch.ones(40).double()


def scene(dtype: torch.dtype = torch.float64) -> dict[str, Any]:
    """A scene that is accepted."""
    return {**case("tall", dtype), "background": torch.zeros(3, dtype=dtype), "backend": "reference"}


def refused(changes: dict[str, Any], *words: str) -> None:
    """Assert that the scene with `changes` raises an InputError of one line that has all `words`."""
    with pytest.raises(InputError) as error:
        rasterize(**scene() | changes)
    assert "\n" not in str(error.value)
    for word in words:
        assert word in str(error.value)


def doubles(*shape: int) -> Tensor:
    return torch.zeros(shape, dtype=torch.float64)


def intrinsics(*rows: list[float]) -> Tensor:
    return torch.tensor([rows], dtype=torch.float64)


def test_the_scene_itself_is_accepted():
    """Catches a scene that is refused for another reason than the one tested; finite values whose sum is not, too."""
    assert {k: tuple(scene()[k].shape) for k in TENSORS} == TENSORS
    rasterize(**scene())
    rasterize(**scene() | {"background": None})
    rasterize(**scene(torch.float32) | {"colors": torch.full((40, 3), 3e38)})


@pytest.mark.parametrize("name", TENSORS)
def test_shapes_types_and_values_of_tensors(name):
    """Catches a shape that is let in and fails in the depths, or draws nonsense by broadcasting; mixed precision,
    integers, and a tensor on another device; NaN and infinities, which would be drawn as nothing and train as NaN."""
    shape, value = TENSORS[name], scene()[name]
    # Colours may have any number of channels (background then does not fit), one set a camera.
    for wrong in ((), (0,), (7,), (*shape, 1), (1, *shape), (*shape[:-1], 2)):
        if (name, wrong) not in {("colors", (1, 40, 3)), ("colors", (40, 2)), ("means", (1, 40, 3))}:
            refused({name: doubles(*wrong)}, name)
    refused({name: [[0.0]]}, f"{name}: expected a tensor, got list")
    refused({name: value.int()}, name if name != "means" else "expected float32 or float64")
    if name == "means":  # to which the others are held
        refused({"opacities": scene()["opacities"].float()}, "opacities")
    else:
        refused({name: value.float()}, name)
        refused({name: value.to("meta")}, name)
    for bad in (NAN, INF, -INF):
        spoiled = value.clone()
        spoiled.view(-1)[-1] = bad
        refused({name: spoiled}, f"{name}: expected finite values")


@pytest.mark.parametrize("backend", ["reference", "cpu", "auto"])
def test_kinds_of_tensors(backend):
    """Catches half precision, sparse and complex tensors that fail in the depths or are drawn in too few digits."""
    kinds = {
        "got float16: convert it by .to(torch.float32)": Tensor.half,
        "got bfloat16": Tensor.bfloat16,
        "got complex64": lambda x: x.to(torch.complex64),
        "got int64": Tensor.long,
        "expected a dense tensor, got a sparse_coo one": Tensor.to_sparse,
        "expected a tensor, got ndarray": Tensor.numpy,
        "on the meta device": lambda x: x.to("meta"),
    }
    arguments = scene(torch.float32) | {"backend": backend}
    for message, change in kinds.items():
        for name in TENSORS:
            refused(arguments | {name: change(arguments[name])}, f"{name}: ", message)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *[
            ({key: value}, f"{key}={value!r}")
            for key, value in (
                ("width", 0),
                ("height", -3),
                ("width", 8.5),
                ("width", "8"),
                ("width", True),
                ("near", None),
                ("near", 0.0),
                ("near", -1.0),
                ("near", NAN),
                ("far", NAN),
                ("eps2d", -0.1),
                ("eps2d", NAN),
                ("eps2d", INF),
            )
        ],
        ({"near": 2.0, "far": 2.0}, "far=2.0"),
        ({"antialias": "no"}, "antialias"),
        ({"backend": 3}, "backend"),
        ({"backend": "refrence"}, "Did you mean 'reference'?"),
        ({"backend": ""}, "raster backend ''"),
        ({"opacities": torch.full((40,), 1.5).double()}, "opacities: expected values in [0, 1]"),
        ({"opacities": torch.full((40,), -0.1).double()}, "opacities: expected values in [0, 1]"),
        ({"Ks": intrinsics([-5, 0, 0], [0, 5, 0], [0, 0, 1])}, "Ks: expected positive focal lengths"),
        ({"Ks": intrinsics([5, 0, 0], [0, 0, 0], [0, 0, 1])}, "Ks: expected positive focal lengths"),
        ({"Ks": intrinsics([5, 0.1, 8], [0, 5, 6], [0, 0, 1])}, "skew is not drawn"),
        ({"Ks": intrinsics([5, 0, 8], [0, 5, 6], [0, 0, 2])}, "Ks: expected [fx 0 cx; 0 fy cy; 0 0 1]"),
        ({"opacities": doubles(39)}, "opacities: expected shape [40], got [39]"),
        ({"means": doubles(1, 40, 3)}, "factors: expected shape [1, 40, 3, 3], got [40, 3, 3]"),
        ({"means": doubles(2, 40, 3)}, "means: expected shape [1, 40, 3], got [2, 40, 3]"),
        ({"colors": doubles(2, 40, 3)}, "colors: expected shape [1, 40, 3], got [2, 40, 3]"),
        ({"colors": doubles(40, 2)}, "background: expected shape [2], got [3]"),
        ({"Ks": torch.eye(3).double().repeat(2, 1, 1)}, "Ks: expected shape [1, 3, 3], got [2, 3, 3]"),
        ({"colors": doubles(40, 0), "background": None}, "colors"),
        ({"colors": 0.5, "background": None}, "colors: expected a tensor, got float"),
        ({"viewmats": doubles(0, 4, 4), "Ks": doubles(0, 3, 3)}, "viewmats"),
        ({"beta_exponents": 2.0}, "beta_exponents: expected a tensor, got float"),
        ({"beta_exponents": SHAPES[:1]}, "beta_exponents: expected shape [40], got [1]"),
        ({"beta_exponents": SHAPES[:, None]}, "beta_exponents: expected shape [40], got [40, 1]"),
        ({"beta_exponents": SHAPES.float()}, "beta_exponents: expected torch.float64 as means are, got torch.float32"),
        ({"beta_exponents": SHAPES.int()}, "beta_exponents: expected float32 or float64, got int32"),
        ({"beta_exponents": SHAPES.to("meta")}, "beta_exponents: expected a tensor with values"),
        *[
            ({"beta_exponents": torch.where(torch.arange(40) == 7, bad, SHAPES)}, f"beta_exponents: expected {message}")
            for bad, message in (
                (0.0, "exponents above 0, got 0.0"),
                (-1.0, "exponents above 0, got -1.0"),
                (NAN, "finite"),
                (INF, "finite"),
            )
        ],
    ],
)
def test_values(changes, message):
    """Catches a number out of its range, or rows that do not agree, that would draw an empty or a wrong picture."""
    refused(changes, message)


def test_gaussians_are_counted_for_every_camera(monkeypatch):
    """Catches more splats than int32 numbers because there are several cameras: 40 Gaussians in 2 are 80."""
    single = scene(torch.float32) | {"backend": "cpu"}
    monkeypatch.setattr(native, "MAX_PAIRS", 79)
    two = {name: single[name].repeat(2, 1, 1) for name in ("viewmats", "Ks")}
    refused(single | two, "at most 79 Gaussians times cameras, got 80")


@pytest.mark.parametrize("backend", ["reference", "cpu"])
def test_memory_is_asked_for(backend, monkeypatch):
    """Catches an image, or colours of stride 0, that take more memory than there is and end the process."""
    monkeypatch.setattr(memory, "available", lambda: 24 << 30)
    refused({"width": 10**7, "height": 10**7, "backend": backend}, "GiB are available")
    many = {name: torch.zeros(1, *shape[1:]).expand(10**8, *shape[1:]) for name, shape in list(TENSORS.items())[:4]}
    arguments = scene(torch.float32) | {"background": None, "backend": backend}
    refused(arguments | many, "with 100000000 Gaussians need" if backend == "reference" else "got 100000000")


@pytest.mark.parametrize(
    ("built", "has_kernels", "device", "message"),
    [
        (True, True, "cpu", "no CUDA device was found"),
        (False, True, "cuda", "the CUDA kernels are not built"),
        (False, False, "cpu", "kernels are not built .* is slow; reinstall with a C\\+\\+20 compiler"),
    ],
)
def test_auto_warns_once_that_it_is_slow(built, has_kernels, device, message, monkeypatch):
    """Catches a GPU without kernels, or none, or no compiler, passed over silently, and a warning at each picture."""
    backends._warn_once.cache_clear()
    monkeypatch.setattr(cuda, "available", lambda: False)
    monkeypatch.setattr(cuda, "built", lambda: built)
    if not has_kernels:
        monkeypatch.setattr(kernels, "available", lambda: False)
    with pytest.warns(UserWarning, match=message):
        fallback = resolve("auto", device)
    assert fallback is REFERENCE or (has_kernels and fallback.name == "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert resolve("auto", device) == fallback
    backends._warn_once.cache_clear()


@pytest.mark.parametrize(
    ("built", "device", "message"),
    [
        (False, False, "it is not built here"),
        (True, False, "no CUDA device was found"),
        (True, True, "does not render on device 'cpu': use device=cuda"),
    ],
)
def test_cuda_without_its_kernels_its_gpu_or_tensors_on_it(built, device, message, monkeypatch):
    """Catches a run that asks for the GPU and finds out in the depths, or in the first picture, that it cannot."""
    monkeypatch.setattr(cuda, "built", lambda: built)
    monkeypatch.setattr(cuda, "available", lambda: device)
    refused({"backend": "cuda"}, message)
    with pytest.raises(InputError, match="raster backend 'cuda'"):
        resolve("cuda", "cpu")


def test_auto_falls_back_to_the_reference():
    """Catches `auto` choosing a backend that cannot serve the tensors: the native one has no float64."""
    assert not AUTO.serves(torch.zeros(1, dtype=torch.float64))
    assert not REFERENCE.serves(torch.zeros(1))
