"""Model families that candidates import, one a module: `from asia.models import linear`.

Each has `Config`, `build(config, context)` and `train(model, trajectories, context, method)`;
training methods are in `asia.models.methods`. Importing this package loads no numerical library.
"""

__all__: list[str] = []
