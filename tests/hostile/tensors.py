"""Disturb tensors at random: their layout in memory, which changes nothing, or their type, shape and values."""

import random
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

Change = Callable[[Tensor], Any]

LAYOUTS: dict[str, Change] = {
    "every second row": lambda x: x.repeat_interleave(2, 0)[::2],
    "every second column": lambda x: x.repeat_interleave(2, -1)[..., ::2],
    "transposed": lambda x: x.transpose(0, -1).contiguous().transpose(0, -1),
    "inside a larger one": lambda x: torch.cat([x, x, x])[len(x) : 2 * len(x)],
    "a negated view": lambda x: torch._neg_view(-x),
}
REPEATED: dict[str, Change] = {
    "one row for all, stride 0": lambda x: x[:1].expand(x.shape),
    "one column for all, stride 0": lambda x: x[..., :1].expand(x.shape),
    "overlapping": lambda x: x.flatten()[: len(x)].as_strided(x.shape, (0,) * (x.dim() - 1) + (1,)),
}
KINDS = ("float16", "bfloat16", "float64", "int32", "int64", "uint8", "bool", "complex64", "float8_e4m3fn")
OTHERS: dict[str, Change] = {
    **{kind: lambda x, kind=kind: x.to(getattr(torch, kind)) for kind in KINDS},
    "sparse": lambda x: x.to_sparse(),
    "mkldnn": lambda x: x.detach().to_mkldnn(),
    "quantised": lambda x: torch.quantize_per_tensor(x.detach(), 0.1, 0, torch.quint8),
    "on the meta device": lambda x: x.to("meta"),
    "numpy": lambda x: x.detach().numpy(),
    "a list": lambda x: x.tolist(),
    "None": lambda _: None,
    "text": lambda _: "x",
    "a number": lambda _: 1.0,
    "no rows": lambda x: x[:0],
    "one row fewer": lambda x: x[:-1],
    "one row more": lambda x: torch.cat([x, x[:1]]),
    "one column more": lambda x: torch.cat([x, x[..., :1]], -1),
    "flat": lambda x: x.flatten(),
    "one dimension more": lambda x: x[None],
    "a scalar": lambda x: x.flatten()[0],
    "a billion rows": lambda x: x[:1].expand(10**9, *x.shape[1:]),
    **{
        f"with {value}": lambda x, value=value: _with(x, value)
        for value in (float("nan"), float("inf"), -1.0, 1e38, -1e38, 1e-45, 1e10)
    },
}


def disturb_layout(r: random.Random, x: Tensor, repeat: bool) -> tuple[Tensor, str]:
    """Return a tensor [N, ...] whose memory is not in rows, and its kind; `repeat` allows one memory for several."""
    kinds = LAYOUTS | REPEATED if repeat else LAYOUTS
    kind = r.choice(list(kinds))
    return kinds[kind](x), kind


def disturb(r: random.Random, x: Tensor) -> tuple[Any, str]:
    """Return something that a function is not made for, and its kind."""
    kind = r.choice(list(OTHERS))
    try:
        return OTHERS[kind](x), kind
    except (RuntimeError, IndexError):  # a scalar has no rows
        return None, "None"


def plain(x: Any) -> Any:
    """Return the same values in rows of memory of its own."""
    if not isinstance(x, Tensor) or x.layout != torch.strided or x.numel() > 10**6:
        return x
    return x.detach().clone(memory_format=torch.contiguous_format)


def _with(x: Tensor, value: float) -> Tensor:
    x = x.clone()
    x.view(-1)[-1] = value
    return x
