"""Mixed precision where it is asked for and the processor computes in it."""

import pytest
import torch

from iga_drake import precision


@pytest.mark.parametrize("asked", [False, True])
@pytest.mark.parametrize("able", [False, True])
def test_products_have_the_precision_that_pays(asked: bool, able: bool, monkeypatch) -> None:
    monkeypatch.setattr(precision, "_processor_has_bfloat16", lambda: able)
    x = torch.eye(4)
    with precision.mixed_precision(x.device, asked):
        product = x @ x
    assert product.dtype == (torch.bfloat16 if asked and able else torch.float32)


@pytest.mark.parametrize(
    ("capabilities", "expected"),
    [({"avx2": True, "avx512_bf16": False}, False), ({"avx512_bf16": True}, True), ({}, False)],
)
def test_a_processor_says_what_it_can(capabilities: dict, expected: bool, monkeypatch) -> None:
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: capabilities, raising=False)
    assert precision._processor_has_bfloat16.__wrapped__() is expected
    monkeypatch.delattr(torch.cpu, "get_capabilities")  # an older PyTorch: the doubt's benefit
    assert precision._processor_has_bfloat16.__wrapped__() is True
