"""The fused training loss against the one written in torch."""

import pytest
import torch

from gsbench.errors import InputError
from gsbench.kernels.loss import l1_ssim
from gsbench.scenes.scene import to_floats
from gsbench.train.losses import photometric

# Rows are filtered four at a time from fourteen: every height about those numbers, and widths about whole vectors. More
# than 448 columns are done in blocks.
SIZES = [(1, 1), (3, 40), (4, 5), (5, 16), (6, 1), (11, 1), (12, 21), (13, 5), (14, 32), (15, 6), (17, 33), (18, 11),
         (19, 1), (20, 7), (21, 7), (48, 16), (90, 61), (17, 449), (13, 1000)]  # fmt: skip


def pictures(height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Two that differ, and are equal in a few rows, where |a - b| has no slope."""
    g = torch.Generator().manual_seed(height)
    a = torch.rand(height, width, 3, generator=g)
    b = (a + 0.2 * torch.randn(a.shape, generator=g)).clamp(0, 1)
    b[1:3] = a[1:3]
    return a, b


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize(("height", "width"), SIZES)
def test_value_and_gradient(height: int, width: int, ssim_weight: float) -> None:
    """Catches a wrong window, padding, edge or derivative, in pictures smaller than the window too."""
    a, b = pictures(height, width)
    exact, fused = a.double().requires_grad_(), a.clone().requires_grad_()
    expected = photometric(exact, b.double(), ssim_weight)
    actual = l1_ssim(fused, b, ssim_weight)
    (3 * expected).backward()
    (3 * actual).backward()
    assert actual.item() == pytest.approx(expected.item(), rel=1e-5, abs=1e-6)
    assert fused.grad is not None
    assert exact.grad is not None
    torch.testing.assert_close(fused.grad.double(), exact.grad, rtol=1e-3, atol=2e-5 * exact.grad.abs().max().item())
    assert l1_ssim(a, b, ssim_weight).item() == actual.item()  # without a gradient: the same value


@pytest.mark.usefixtures("threads", "instruction_set")
@pytest.mark.parametrize("height", [1, 2, 5, 11, 13, 14, 15, 23, 90])
def test_same_bits_for_any_number_of_threads(height: int) -> None:
    """Catches strips of the picture that see other neighbours, or sums in another order.

    Strips begin and end anywhere in a group of rows: a row that is gone when the next group wants it differs here too.
    """
    a, b = pictures(height, 61)
    results = []
    for number in (1, 2, 3, 7):
        torch.set_num_threads(number)
        image = a.clone().requires_grad_()
        loss = l1_ssim(image, b, 0.2)
        loss.backward()
        results.append((loss.detach(), image.grad))
    assert all(torch.equal(x, y) for other in results[1:] for x, y in zip(results[0], other, strict=True))


@pytest.mark.usefixtures("instruction_set")
@pytest.mark.parametrize(("height", "width"), [(1, 1), (12, 21), (16, 17), (17, 449)])
def test_bytes_have_the_bits_of_floats(height: int, width: int) -> None:
    """Catches a byte divided with another rounding, read as signed, or read past the end of a row."""
    a, b = pictures(height, width)
    in_bytes = (255 * b).round().to(torch.uint8)
    in_bytes.view(-1)[:256] = torch.arange(256, dtype=torch.uint8)[: in_bytes.numel()]
    results = []
    for target in (in_bytes, to_floats(in_bytes)):
        image = a.clone().requires_grad_()
        loss = l1_ssim(image, target, 0.2)
        loss.backward()
        results.append((loss.detach(), image.grad))
    assert all(torch.equal(x, y) for x, y in zip(*results, strict=True))


def test_errors() -> None:
    """Catches pictures of different size or type that would be read past their end."""
    a, b = pictures(8, 8)
    with pytest.raises(InputError, match="of one size"):
        l1_ssim(a, b[1:], 0.2)
    with pytest.raises(InputError, match="float32"):
        l1_ssim(a.double(), b.double(), 0.2)
    with pytest.raises(InputError, match="target: expected float32 or uint8, got int8"):
        l1_ssim(a, b.to(torch.int8), 0.2)
    with pytest.raises(InputError, match="no gradient by target"):
        l1_ssim(a, b.requires_grad_(), 0.2)
