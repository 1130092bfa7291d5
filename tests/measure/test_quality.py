"""PSNR, SSIM and LPIPS: by hand, by property, by known answers, and against the real lpips package."""

import hashlib
import math
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from forked import python
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gsbench.errors import InputError
from gsbench.measure import perceptual, quality
from gsbench.measure.perceptual import BackboneMissing

SHARED = Path(os.environ.get("GSBENCH_SHARED", Path(__file__).parents[3] / "shared"))
LPIPS = SHARED / "data" / "lpips"
TRUNK = LPIPS / "alexnet_features_torchvision_f32.npz"
needs_trunk = pytest.mark.skipif(not TRUNK.exists(), reason=f"no AlexNet trunk at {TRUNK}")


@pytest.fixture
def no_weights(tmp_path, monkeypatch):
    """A machine that has no torchvision weights."""
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    perceptual.load.cache_clear()
    return tmp_path


def image(seed: int, height: int = 32, width: int = 40) -> Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def example(name: str) -> Tensor:
    return torch.from_numpy(cv2.cvtColor(cv2.imread(str(LPIPS / name)), cv2.COLOR_BGR2RGB)).float() / 255


def test_psnr_by_hand():
    """Would catch a wrong peak, a natural logarithm, or a mean that is not joint over H x W x 3."""
    a, b = torch.zeros(4, 5, 3), torch.full((4, 5, 3), 0.1)
    assert quality.psnr(a, b) == pytest.approx(20.0, abs=1e-5)
    b = torch.zeros(4, 5, 3)
    b[..., 0] = 0.1  # mean squared error 0.01 / 3 jointly; the other two channels are equal
    assert quality.psnr(a, b) == pytest.approx(20 + 10 * math.log10(3), abs=1e-5)
    assert quality.psnr_channel_mean(a, b) == pytest.approx((20 + 100 + 100) / 3, abs=1e-4)  # capped: exact_views
    b[..., 1], b[..., 2] = 0.01, 0.001
    assert quality.psnr_channel_mean(a, b) == pytest.approx((20 + 40 + 60) / 3, abs=1e-4)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.floats(0.01, 0.5), st.integers(1, 9), st.integers(1, 9))
def test_psnr_properties(seed, noise, height, width):
    """Would catch a PSNR that depends on the order, a channel mean below the joint one (Jensen forbids it), and broken
    pixels of a diverged render that score as if they were black or skipped."""
    a = image(seed, height, width)
    b = (a + noise * image(seed + 1, height, width)).clamp(0, 1)
    assert quality.psnr(a, b) == quality.psnr(b, a)
    assert quality.psnr(a, a) == math.inf
    assert quality.psnr_channel_mean(a, b) >= quality.psnr(a, b) - 1e-9
    assert quality.psnr(a, (a + b) / 2) >= quality.psnr(a, b)
    assert quality.psnr(a + 10, b) == quality.psnr(torch.ones_like(a), b)  # clamped
    a[0, 0, 0] = math.nan
    assert math.isnan(quality.psnr(a, b))
    assert math.isnan(quality.psnr_channel_mean(a, b))


def test_ssim_against_its_formula():
    """Would catch scikit-image called with other settings: Wang et al. 2004, eq. 13, written out with OpenCV's filter.
    On this pair data_range=2 is 8e-3 off, a uniform window 6e-3, a sample covariance 2e-5."""
    a, b = image(0, 40, 50), image(1, 40, 50) * 0.5 + image(0, 40, 50) * 0.5
    x, y = a.double().numpy(), b.double().numpy()

    def blur(z: np.ndarray) -> np.ndarray:
        return cv2.GaussianBlur(z, (11, 11), 1.5, borderType=cv2.BORDER_REFLECT)[5:-5, 5:-5]

    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    c1, c2 = 0.01**2, 0.03**2
    expected = (2 * mx * my + c1) * (2 * vxy + c2) / ((mx * mx + my * my + c1) * (vx + vy + c2))
    assert quality.ssim(a, b) == pytest.approx(expected.mean(), abs=1e-9)
    assert quality.ssim(a, a) == 1.0
    a[3, 4, 1] = math.nan
    assert math.isnan(quality.ssim(a, b))


@pytest.mark.parametrize("shape", [(20, 20), (3, 20, 20), (20, 20, 4), (1, 20, 20, 3), (0, 20, 3)])
def test_what_is_not_two_images_is_refused(shape):
    """Would catch broadcasting, [3, H, W] taken for an image, alpha scored as colour, and 0..255 clamped to 1."""
    right = torch.rand(20, 20, 3)
    for a, b in ((torch.rand(shape),) * 2, (right, torch.rand(20, 21, 3)), ((right * 255).byte(),) * 2):
        for measure in (quality.psnr, quality.psnr_channel_mean, quality.ssim):
            with pytest.raises(InputError, match="expected"):
                measure(a, b)


def test_quantise_is_an_8_bit_png():
    """Would catch truncation instead of rounding, and levels that a PNG does not have."""
    x = image(0)
    png = cv2.imdecode(cv2.imencode(".png", (x.numpy() * 255).round().astype(np.uint8))[1], cv2.IMREAD_UNCHANGED)
    assert torch.equal(quality.quantise(x), torch.from_numpy(png).float() / 255)
    assert torch.equal(quality.quantise(torch.tensor([-1.0, 2.0])), torch.tensor([0.0, 1.0]))
    with pytest.raises(InputError, match="quantise: the image"):
        quality.quantise(x.tolist())


@needs_trunk
@pytest.mark.parametrize(("other", "known"), [("ex_p0.png", 0.722), ("ex_p1.png", 0.138)])
def test_lpips_known_answers(other, known):
    """Would catch [0, 1] fed for [-1, 1], BGR for RGB, version 0.0's weights: the three digits lpips' README gives."""
    assert quality.lpips(example("ex_ref.png"), example(other), "alex", TRUNK) == pytest.approx(known, abs=5e-4)
    assert quality.lpips(example("ex_ref.png"), example("ex_ref.png"), "alex", TRUNK) == 0.0


def test_lpips_agrees_with_the_lpips_package():
    """Would catch any difference from lpips 0.1.4 on one random trunk, AlexNet and VGG16, to the last bit."""
    pytest.importorskip("scipy")
    script = Path(__file__).parent / "lpips_agreement.py"
    done = python(str(script))
    assert done.stdout == "agree\n", done.stderr[-2000:]


@pytest.mark.usefixtures("no_weights")
def test_a_missing_backbone_leaves_its_column_empty_with_the_reason():
    """Would catch a run that stops, or an empty column nobody can explain, on a machine without the weights."""
    for backbone in ("alex", "vgg"):
        with pytest.raises(BackboneMissing, match=f"needs weights: `python -m gsbench.fetch lpips-{backbone}`"):
            perceptual.load(backbone)
    truth = image(0)
    measured = quality.evaluate([("a", image(1), truth)], background=(0.0, 0.0, 0.0))
    assert measured.metrics["lpips_alex"] is None
    assert "gsbench.fetch lpips-alex" in measured.missing["lpips_alex"]
    assert "gsbench.fetch lpips-vgg" in measured.missing["lpips_vgg"]
    assert measured.metrics["ssim"] == quality.ssim(image(1), truth)


def test_wrong_weights_are_never_used(no_weights):
    """Would catch a truncated download or another network's weights giving a plausible LPIPS."""
    named = no_weights / "mine.npz"
    np.savez(named, **{"features.0.weight": np.zeros((64, 3, 11, 11), np.float32)})
    with pytest.raises(InputError, match=r"mine\.npz: expected SHA-256 7be5be79"):
        perceptual.load("alex", named)
    measured = no_weights / "hub" / "checkpoints" / "vgg16-397923af.pth"
    measured.parent.mkdir(parents=True)
    torch.save({}, measured)
    with pytest.raises(InputError, match="SHA-256 397923af"):
        quality.evaluate([("a", image(0), image(1))], background=(0.0, 0.0, 0.0))
    with pytest.raises(InputError, match="no such file"):
        perceptual.load("alex", no_weights / "typo.npz")
    with pytest.raises(InputError, match="Did you mean 'alex'"):
        perceptual.load("alexnet")


def test_torchvision_weights_are_found_by_name_and_hash(no_weights, monkeypatch):
    """Would catch a reader that trips over torchvision's classifier, or that forgets TORCH_HOME. Invented weights."""
    path = no_weights / "hub" / "checkpoints" / "alexnet-owt-7be5be79.pth"
    path.parent.mkdir(parents=True)
    trunk = perceptual.BACKBONES["alex"].trunk()
    state = {f"features.{key}": value for key, value in trunk.state_dict().items()}
    torch.save(state | {"classifier.1.weight": torch.zeros(4, 4)}, path)
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    monkeypatch.setattr(perceptual.Backbone, "trunk_sha256", (sha256,), raising=True)
    loaded = perceptual.load("alex")
    assert torch.equal(loaded.trunk[0].weight, trunk[0].weight)
    assert perceptual.load("alex") is loaded
    assert 0 < quality.lpips(image(0), image(1)) < 10
    perceptual.load.cache_clear()


@pytest.mark.usefixtures("no_weights")
def test_evaluate_means_over_views_and_quantises_on_request():
    """Would catch a mean over pixels, truth that is quantised too, a wrong background."""
    truth = [torch.full((16, 16, 3), 0.5), torch.full((16, 16, 3), 0.25)]
    render = [t + 0.0019 for t in truth]
    measured = quality.evaluate(zip("ab", render, truth, strict=True), background=(1.0, 1.0, 1.0))
    assert [view.name for view in measured.per_view] == ["a", "b"]
    assert measured.metrics["psnr"] == pytest.approx(sum(v.psnr for v in measured.per_view) / 2)
    assert measured.metrics["psnr"] == pytest.approx(-20 * math.log10(0.0019), abs=1e-3)
    expected = (quality.psnr(torch.ones(16, 16, 3), truth[0]) + quality.psnr(torch.ones(16, 16, 3), truth[1])) / 2
    assert measured.metrics["psnr_background_only"] == pytest.approx(expected)
    eight = quality.evaluate(zip("ab", render, truth, strict=True), background=(1.0, 1.0, 1.0), quantised=True)
    assert eight.per_view[0].psnr == quality.psnr(quality.quantise(render[0]), truth[0])
    assert eight.metrics["psnr"] != measured.metrics["psnr"]


@pytest.mark.usefixtures("no_weights")
def test_a_picture_too_small_for_a_metric_leaves_it_empty():
    """Would catch a run at a strong downscale that ends in an exception of scikit-image or of a pooling layer."""
    measured = quality.evaluate([("tiny", image(0, 10, 40), image(1, 10, 40))], background=(0.0, 0.0, 0.0))
    assert measured.metrics["psnr"] is not None
    for metric, side in (("ssim", 11), ("lpips_alex", 31), ("lpips_vgg", 16)):
        assert measured.metrics[metric] is None
        assert measured.missing[metric] == f"needs {side} pixels a side, tiny has 10"
    for backbone in perceptual.BACKBONES.values():
        backbone.trunk()(torch.zeros(1, 3, backbone.least_side, backbone.least_side))
        with pytest.raises(RuntimeError, match="too small"):
            backbone.trunk()(torch.zeros(1, 3, backbone.least_side - 1, backbone.least_side - 1))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")
@needs_trunk
def test_a_gpu_gives_the_same_numbers():
    """Would catch a metric that stays on the CPU or is computed in lower precision on the GPU (TF32)."""
    a, b = example("ex_ref.png"), example("ex_p0.png")
    assert quality.psnr(a.cuda(), b.cuda()) == pytest.approx(quality.psnr(a, b), abs=1e-9)
    assert quality.ssim(a.cuda(), b.cuda()) == pytest.approx(quality.ssim(a, b), abs=1e-9)
    assert quality.lpips(a.cuda(), b.cuda(), "alex", TRUNK) == pytest.approx(
        quality.lpips(a, b, "alex", TRUNK), abs=1e-4
    )


def test_evenly_spaced_views():
    """Catches a subset of the first views only, of more than there are, or of another number than asked for."""
    assert quality.evenly(range(10), 5) == [0, 2, 4, 6, 8]
    assert quality.evenly(range(7), 3) == [0, 2, 4]
    assert quality.evenly(range(3), 10) == [0, 1, 2]
    assert quality.evenly([], 4) == []
