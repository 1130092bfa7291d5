"""The fused training loss against the one written in torch."""

import pytest
import torch

from gsbench.errors import InputError
from gsbench.kernels.loss import l1_ssim
from gsbench.scenes.scene import to_floats
from gsbench.train.losses import photometric

# Rows are filtered four at a time from fourteen: every height about those numbers, and widths about whole vectors. More
# than 448 columns are done in blocks; a GPU's tiles are of 16 x 16.
SIZES = [
    *((1, 1), (3, 40), (4, 5), (5, 16), (6, 1), (11, 1), (12, 21), (13, 5), (14, 32), (15, 6), (16, 16)),
    *((17, 33), (18, 11), (19, 1), (20, 7), (21, 7), (37, 50), (48, 16), (90, 61), (17, 449), (13, 1000)),
]


def pictures(height: int, width: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Two that differ, and are equal in a few rows, where |a - b| has no slope."""
    g = torch.Generator().manual_seed(height + seed)
    a = torch.rand(height, width, 3, generator=g)
    b = (a + 0.2 * torch.randn(a.shape, generator=g)).clamp(0, 1)
    b[1:3] = a[1:3]
    return a, b


def value_and_gradient(image: torch.Tensor, target: torch.Tensor, weight: float = 0.2) -> list[torch.Tensor]:
    leaf = image.clone().requires_grad_()
    loss = l1_ssim(leaf, target, weight)
    (3 * loss).backward()
    return [loss.detach(), leaf.grad]


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient(height, width, ssim_weight, place):
    """Catches a wrong window, padding, edge or derivative, in pictures smaller than the window too."""
    a, b = pictures(height, width)
    exact = a.double().requires_grad_()
    expected = photometric(exact, b.double(), ssim_weight)
    (3 * expected).backward()
    value, gradient = value_and_gradient(place.move(a), place.move(b), ssim_weight)
    assert value.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-6)
    atol = 2e-5 * exact.grad.abs().max().item()
    torch.testing.assert_close(gradient.cpu().double(), exact.grad, rtol=1e-3, atol=atol)
    assert l1_ssim(place.move(a), place.move(b), ssim_weight).item() == value.item()  # without a gradient: the same


@pytest.mark.parametrize(("height", "width"), [(1, 1), (12, 21), (17, 33)])
def test_several_images_have_the_bits_of_each(height, width, place):
    """Catches an image that is compared with another's target, a gradient of another's loss, and sums over all."""
    images, targets = (torch.stack(x) for x in zip(*(pictures(height, width, seed) for seed in range(4)), strict=True))
    in_bytes = (255 * targets).round().to(torch.uint8)
    weights = torch.arange(1.0, 5)
    for each in (place.move(targets), in_bytes.to(place.device)):
        results = []
        for parts in (slice(None),), [slice(i, i + 1) for i in range(4)], range(4):
            leaf = place.move(images).requires_grad_()
            losses = torch.cat([l1_ssim(leaf[i], each[i], 0.2).view(-1) for i in parts])
            (losses * weights.to(losses)).sum().backward()
            results.append([losses.detach(), leaf.grad])
        assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


@pytest.mark.usefixtures("threads", "instruction_set")
@pytest.mark.parametrize("height", [1, 2, 5, 11, 13, 14, 15, 23, 90])
def test_same_bits_for_any_number_of_threads(height):
    """Catches strips of the picture that see other neighbours, or sums in another order. Strips begin and end anywhere
    in a group of rows: a row that is gone when the next group wants it differs here too."""
    results = []
    for number in (1, 2, 3, 7):
        torch.set_num_threads(number)
        results.append(value_and_gradient(*pictures(height, 61)))
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


@pytest.mark.parametrize(("height", "width"), [(1, 1), (12, 21), (16, 17), (37, 50), (17, 449)])
def test_bytes_have_the_bits_of_floats(height, width, place):
    """Catches a byte divided with another rounding, read as signed, or read past the end of a row."""
    a, b = pictures(height, width)
    in_bytes = (255 * b).round().to(torch.uint8)
    in_bytes.view(-1)[:256] = torch.arange(256, dtype=torch.uint8)[: in_bytes.numel()]
    in_bytes = in_bytes.to(place.device)
    results = [value_and_gradient(place.move(a), target) for target in (in_bytes, to_floats(in_bytes))]
    assert all(torch.equal(x, y) for x, y in zip(*results, strict=True))


def test_errors():
    """Catches pictures of different size or type that would be read past their end."""
    a, b = pictures(8, 8)
    for first, second, message in (
        (a, b[1:], "of one size"),
        (a.double(), b.double(), "float32"),
        (a, b.to(torch.int8), "target: expected float32 or uint8, got int8"),
        (a, b.clone().requires_grad_(), "no gradient by target"),
    ):
        with pytest.raises(InputError, match=message):
            l1_ssim(first, second, 0.2)
