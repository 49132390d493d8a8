"""Muon (Jordan et al., "Muon: an optimizer for hidden layers in neural networks", 2024) in single
precision, matrices of one shape at once.

`torch.optim.Muon` makes the same steps, in bfloat16 and one matrix at a time. On processors without
bfloat16 arithmetic that takes longer than forward and backward pass of a small network together.
"""

from collections.abc import Callable, Iterable
from itertools import groupby
from typing import Any

import torch
from torch import Tensor, nn

NEWTON_SCHULZ = (3.4445, -4.7750, 2.0315)  # coefficients of the quintic iteration
MOMENTUM = 0.95


def orthogonalised(matrices: Tensor, steps: int = 5) -> Tensor:
    """(..., m, n) with their singular values brought near one, between about 0.7 and 1.2."""
    a, b, c = NEWTON_SCHULZ
    tall = matrices.shape[-2] > matrices.shape[-1]
    X = matrices.mT if tall else matrices
    X = X / X.norm(dim=(-2, -1), keepdim=True).clamp_min(1e-7)
    for _ in range(steps):
        gram = X @ X.mT
        X = a * X + (b * gram + c * gram @ gram) @ X
    return X.mT if tall else X


class Muon(torch.optim.Optimizer):
    """The optimizer Muon, which trains matrices alone.

    A step has the size of one of AdamW at the same learning rate (Liu et al., "Muon is scalable for
    LLM training", 2025); weight decay is decoupled.

    The state of each parameter is its `momentum_buffer`, as in `torch.optim.Muon`.
    """

    def __init__(self, params: Iterable[Any], lr: float, weight_decay: float):
        """`params` are matrices, or groups of them as dictionaries.

        Raises `ValueError` for a parameter that is no matrix.
        """
        super().__init__(params, {"lr": lr, "weight_decay": weight_decay})
        for parameter in self._parameters():
            if parameter.ndim != 2:
                raise ValueError(f"Muon: a parameter of shape {tuple(parameter.shape)}, no matrix")

    def _parameters(self) -> list[nn.Parameter]:
        return [parameter for group in self.param_groups for parameter in group["params"]]

    @torch.no_grad()
    def step(self, closure: Callable[[], float] | None = None) -> float | None:  # type: ignore[override]
        """Makes a step from the gradients; parameters that have none stay."""
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        for group in self.param_groups:
            moving = sorted(
                (p for p in group["params"] if p.grad is not None), key=lambda p: tuple(p.shape)
            )
            for (m, n), same in groupby(moving, key=lambda p: tuple(p.shape)):
                parameters = list(same)
                update = orthogonalised(torch.stack([self._nesterov(p) for p in parameters]))
                length = group["lr"] * 0.2 * max(m, n) ** 0.5
                for parameter, direction in zip(parameters, update, strict=True):
                    parameter.mul_(1 - group["lr"] * group["weight_decay"])
                    parameter.add_(direction, alpha=-length)
        return loss

    def _nesterov(self, parameter: nn.Parameter) -> Tensor:
        gradient, state = parameter.grad, self.state[parameter]
        assert gradient is not None
        if "momentum_buffer" not in state:
            state["momentum_buffer"] = torch.zeros_like(gradient)
        momentum: Tensor = state["momentum_buffer"]
        momentum.lerp_(gradient, 1 - MOMENTUM)
        return gradient.lerp(momentum, MOMENTUM)
