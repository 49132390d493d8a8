"""Mixed precision where it pays."""

import functools

import torch


@functools.cache
def _processor_has_bfloat16() -> bool:
    known = getattr(torch.cpu, "get_capabilities", None)  # not in older releases
    return known is None or any(known().get(k) for k in ("avx512_bf16", "amx_bf16", "bf16"))


def mixed_precision(device: torch.device, asked: bool) -> torch.autocast:
    """Autocast to bfloat16 where `asked` for, but not on processors without bfloat16 arithmetic,
    which emulate it: a training step of the paper's network takes some 15 times as long there."""
    able = device.type != "cpu" or _processor_has_bfloat16()
    return torch.autocast(device.type, torch.bfloat16, enabled=asked and able)
