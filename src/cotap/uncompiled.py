"""Imported before tensordict, it keeps a command from loading torch's compiler, which takes longer than torch itself.

On import, tensordict registers three of its functions with the compiler, and so loads it. Where nothing is compiled, as
in the commands, they need not be registered. Without effect where tensordict is imported already.
"""

import torch.compiler

_kept = {name: getattr(torch.compiler, name) for name in ("allow_in_graph", "assume_constant_result")}
try:
    for _name in _kept:
        setattr(torch.compiler, _name, lambda function: function)
    import tensordict  # noqa: F401
finally:
    for _name, _function in _kept.items():
        setattr(torch.compiler, _name, _function)
