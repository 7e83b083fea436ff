"""A quick start: what the page does not need is not loaded."""

from __future__ import annotations

import contextlib
import gc
from collections.abc import Iterator


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Collect no garbage within: loading makes next to none, and looking for it takes a quarter of the time. What was
    loaded is not looked at again afterwards."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()


def import_tensordict() -> None:
    """Import tensordict without torch's compiler, which takes longer to load than torch itself.

    On import, tensordict informs the compiler about three of its functions. Where nothing is compiled, as on the
    page, that changes nothing. Without effect where tensordict is there already.
    """
    import torch.compiler

    names = ("allow_in_graph", "assume_constant_result")
    kept = {name: getattr(torch.compiler, name) for name in names}
    try:
        for name in names:
            setattr(torch.compiler, name, lambda function: function)
        import tensordict  # noqa: F401
    finally:
        for name, function in kept.items():
            setattr(torch.compiler, name, function)
