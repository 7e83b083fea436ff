"""Imported first, it spares a command torch's compiler, which takes longer to load than torch itself.

On import, tensordict informs the compiler about three of its functions, and so loads it. Where nothing is compiled, as
in the commands, that changes nothing. Without effect where tensordict is there already.
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
