"""A recording repeats kernels and torch operations in the same memory, with the bits of the code that it recorded."""

import subprocess
import sys
import threading
import weakref
from collections.abc import Callable

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import is_in_torch_dispatch_mode

from gsbench.kernels.recording import OutdatedError, Recording, current, paused, read
from gsbench.kernels.slices import slice_static
from gsbench.kernels.tape import Tape


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def repeated(recording: Recording) -> None:
    with torch.no_grad():
        recording.repeat()


def test_a_repetition_has_the_results_of_the_present_values():
    """Catches an operation that is left out: in place, of several results, a copy, into zeros, or through a view."""

    def work(x: Tensor) -> list[Tensor]:
        summed = torch.zeros_like(x)
        summed += x.exp()
        summed[1:] *= 2
        halves = torch.linalg.qr(x.view(4, 2)[:2])
        doubles = x.double().view(2, 4).T.clone() * 2
        return [summed, *halves, x.new_full((2,), 3.0) + x[[1, 3]], torch.cat([x, summed]).sum(), doubles]

    inputs = numbers(8)
    with Recording() as recording:
        results = work(inputs)
    assert recording.is_repeatable
    for seed in (1, 2):
        inputs.copy_(numbers(8, seed=seed))
        repeated(recording)
        assert all(torch.equal(x, y) for x, y in zip(results, work(inputs), strict=True))


def test_kernels_and_gradients_are_repeated():
    """Catches a kernel that is not recorded, a backward pass of the tape, and autograd's where torch is in between."""
    scales, quats, opacities = numbers(50, 3), numbers(50, 4), numbers(50)
    inputs = [scales, quats, opacities]

    def work(sums: dict[int, Tensor]) -> list[Tensor]:
        sources = [x.requires_grad_() for x in inputs]
        with Tape() as tape:
            factors, dimmed = slice_static(scales * 0.5, quats, opacities)
            loss = (factors.square().sum((1, 2)) * dimmed).sum()
        tape.backward(loss, torch.ones(()), sources, sums)
        return [loss.detach(), *[sums[id(x)] for x in sources]]

    with Recording() as recording:
        results = work({})
    assert recording.is_repeatable
    with torch.no_grad():
        for i, x in enumerate(inputs):
            x.copy_(numbers(*x.shape, seed=5 + i))
    repeated(recording)
    assert all(torch.equal(x, y) for x, y in zip(results, work({}), strict=True))
    assert all(x.any() for x in results)


def test_a_recording_that_is_too_large_is_given_up(monkeypatch):
    """Catches hidden layers that are kept for all Gaussians of a batch, 40 GB for four views of 100,000 of them."""
    monkeypatch.setattr("gsbench.kernels.recording.MOST_BYTES", 1_000)
    inputs = torch.zeros(125)
    with Recording() as recording:
        first = inputs + 1  # 500 bytes
        second = first.view(5, 25).mul_(2).view(125) + 1
        assert recording.is_repeatable
        kept = weakref.ref(first)
        third = second[:1] + 1
        del first
        assert not recording.is_repeatable
        assert kept() is None
    assert third.item() == 4


def test_a_number_that_was_read_is_read_again():
    """Catches a repetition with a number that no longer holds, and a reading outside of a recording."""
    count = torch.tensor([3, 1])
    assert read(count, lambda _: False) == [3, 1]
    with Recording() as recording:
        assert read(count, lambda values: values[0] < 5) == [3, 1]
    assert recording.is_repeatable
    count.fill_(4)
    repeated(recording)
    count.fill_(5)
    with pytest.raises(OutdatedError):
        repeated(recording)


def test_what_is_captured_is_repeated(monkeypatch):
    """Catches calls that run while they are captured or are left out of a graph."""
    captured = []

    def graph_of(calls: list[Callable[[], object]]) -> Callable[[], object]:
        captured.append(len(calls))
        return lambda: [call() for call in calls]

    monkeypatch.setattr("gsbench.kernels.recording.graph_of", graph_of)
    x, total = torch.tensor([1, 2]), torch.zeros(1, dtype=torch.int64)
    with Recording() as recording:
        total += (x * 2).sum()
    recording.capture()
    assert captured == [3]
    assert total.item() == 6
    x[0] = 10
    repeated(recording)
    assert total.item() == 6 + 2 * (10 + 2)


def test_what_a_pause_calls_is_not_repeated():
    """Catches operations or reads of a pause in a repetition, and a recording that does not go on after its error."""
    x, total = torch.ones(1, dtype=torch.int64), torch.zeros(1, dtype=torch.int64)

    def fail() -> None:
        with paused():
            assert current() is None
            total.add_(x)
            assert read(total, lambda _: False) == [total.item()]
            raise KeyError

    with Recording() as recording:
        with pytest.raises(KeyError):
            fail()
        assert current() is recording
        total += 10
    assert recording.is_repeatable
    repeated(recording)
    assert total.item() == 21


@pytest.mark.parametrize("work", [Tensor.item, Tensor.nonzero, torch.rand_like, lambda x: x[x > 0]])
def test_what_cannot_be_repeated_says_so(work):
    """Catches a number that Python code read, a shape that depends on values, and a draw without its generator."""
    x = torch.ones(())
    with Recording() as recording:
        work(x)
    assert not recording.is_repeatable


def test_threads_record_one_after_the_other():
    """Catches a recording with another thread's calls, and torch's note of a recording that stays after its end."""
    recorded: list[list[tuple[Recording, Tensor]]] = [[], []]
    inputs = [torch.ones(3), torch.ones(3)]

    def work(thread: int) -> None:
        for _ in range(50):
            with Recording() as recording:
                recorded[thread].append((recording, inputs[thread] * 2))

    threads = [threading.Thread(target=work, args=(i,)) for i in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert current() is None
    assert not is_in_torch_dispatch_mode()
    inputs[0].fill_(2.0)
    for recording, _ in [*recorded[0], *recorded[1]]:
        repeated(recording)
    assert all((result == 4).all() for _, result in recorded[0])
    assert all((result == 2).all() for _, result in recorded[1])


def test_recording_does_not_import_torch_s_compiler():
    """Catches a second that every training would lose, because torch imports its compiler for a dispatch mode."""
    code = (
        "import sys, torch; from gsbench.kernels.recording import Recording\n"
        "with Recording(): torch.ones(2) * 2\n"
        "sys.exit('torch._dynamo' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
