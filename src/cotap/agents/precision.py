"""Which precision the networks run in, chosen from what the CPU offers."""

from __future__ import annotations

import torch

from cotap.checks import require_one_of

PRECISIONS = ("auto", "bf16", "fp32")


def resolve_precision(precision: str, device: str) -> torch.dtype:
    """The networks' compute type: bfloat16 where `auto` finds hardware for it, else float32.

    On CPUs without AVX512-BF16 or AMX, bfloat16 is emulated and slower than float32.
    """
    require_one_of("precision", precision, PRECISIONS)
    if precision == "auto":
        precision = "bf16" if has_fast_bf16(device) else "fp32"
    return torch.bfloat16 if precision == "bf16" else torch.float32


def has_fast_bf16(device: str) -> bool:
    """Whether `device` multiplies bfloat16 matrices in hardware."""
    if torch.device(device).type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    capabilities = torch.cpu.get_capabilities()
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
