"""A quick start: what the page does not need is not loaded."""

from __future__ import annotations

import torch.compiler


def import_tensordict() -> None:
    """Import tensordict without torch's compiler, which takes longer to load than torch itself.

    On import, tensordict tells the compiler how to treat three of its functions. Where nothing is compiled, as on the
    page, that changes nothing. Without effect where tensordict is there already.
    """
    told = ("allow_in_graph", "assume_constant_result")
    kept = {name: getattr(torch.compiler, name) for name in told}
    try:
        for name in told:
            setattr(torch.compiler, name, lambda function: function)
        import tensordict  # noqa: F401
    finally:
        for name, function in kept.items():
            setattr(torch.compiler, name, function)
