"""Muon in single precision against PyTorch's in bfloat16, and against the polar factor."""

import pytest
import torch

from iga_drake.training.muon import Muon, orthogonalised

SHAPES = [(6, 4), (4, 6), (5, 5), (6, 4), (1, 7)]


def _twins(seed: int) -> tuple[list[torch.nn.Parameter], list[torch.nn.Parameter]]:
    generator = torch.Generator().manual_seed(seed)
    made = [torch.randn(*shape, generator=generator) for shape in SHAPES]
    return [torch.nn.Parameter(x.clone()) for x in made], [torch.nn.Parameter(x) for x in made]


def test_steps_are_those_of_pytorch_up_to_its_bfloat16() -> None:
    ours, theirs = _twins(0)
    mine = Muon(ours, lr=0.01, weight_decay=0.1)
    other = torch.optim.Muon(theirs, lr=0.01, weight_decay=0.1, adjust_lr_fn="match_rms_adamw")
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        before = [p.detach().clone() for p in ours]
        for a, b in zip(ours, theirs, strict=True):
            a.grad = torch.randn(a.shape, generator=generator)
            b.grad = a.grad.clone()
        mine.step()
        other.step()
        for a, b, was in zip(ours, theirs, before, strict=True):
            moved = (a - was).norm()
            assert (a - b).norm() < 0.1 * moved + 1e-6
            b.data.copy_(a.data)  # so that rounding does not add up
    for a, b in zip(ours, theirs, strict=True):
        ours_, theirs_ = (
            state[p]["momentum_buffer"] for state, p in ((mine.state, a), (other.state, b))
        )
        torch.testing.assert_close(ours_, theirs_)


@pytest.mark.parametrize("shape", [(8, 8), (12, 5), (5, 12)])
def test_orthogonalised_is_near_the_polar_factor(shape: tuple[int, int]) -> None:
    G = torch.randn(20, *shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    U, S, Vt = torch.linalg.svd(G, full_matrices=False)
    keep = S[:, -1] > 0.05 * S[:, 0]  # tiny singular values take more iterations
    found = U.mT @ orthogonalised(G) @ Vt.mT
    values = found.diagonal(dim1=-2, dim2=-1)[keep]
    assert keep.sum() > 5
    assert values.min() > 0.6 and values.max() < 1.25
    torch.testing.assert_close(found, torch.diag_embed(found.diagonal(dim1=-2, dim2=-1)))


def test_what_has_no_gradient_stays_and_vectors_are_refused() -> None:
    still = torch.nn.Parameter(torch.ones(2, 3))
    Muon([still], lr=0.1, weight_decay=0.1).step()
    assert torch.equal(still.data, torch.ones(2, 3))
    with pytest.raises(ValueError, match=r"shape \(3,\), no matrix"):
        Muon([torch.nn.Parameter(torch.ones(3))], lr=0.1, weight_decay=0.0)
