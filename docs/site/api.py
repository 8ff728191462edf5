"""The page of the Python interface: which names it shows. Their text is their docstrings."""

import pkgutil
from importlib import import_module

import asia
import asia.models
import asia.testing
from asia.control import monitor
from asia.models import methods

INTRODUCTION = """# Python interface

Arrays are float64, in physical units, time first. `B` is the number of cases, `H` the
number of samples to simulate.

```python
import asia

run = asia.run("two_tanks_sim", experiments=8)
print(run.view.best)
y_hat = asia.simulate(run.directory, past_u, past_y, u)
```
"""


def api_page() -> str:
    """Directives for the public names of the package, in the order in which they are met."""
    families = [m.name for m in pkgutil.iter_modules(asia.models.__path__) if m.name[0] != "_"]
    text = [INTRODUCTION, "## asia\n"]
    text += [_directive(asia, "asia", name) for name in asia.__all__]
    text += ["## Model families: asia.models\n"]
    for family in families:
        module = import_module(f"asia.models.{family}")
        if hasattr(module, "Config"):
            text.append(_module(f"asia.models.{family}"))
    text += ["## Training methods: asia.models.methods\n"]
    text += [_directive(methods, "asia.models.methods", name) for name in methods.__all__]
    text += ["## Control: asia.control\n"]
    text += [_directive(monitor, "asia.control.monitor", "Monitor")]
    text += ["## Suites for parts of your own: asia.testing\n"]
    text += [_directive(asia.testing, "asia.testing", name) for name in asia.testing.__all__]
    return "\n".join(text)


def _directive(package: object, shown: str, name: str) -> str:
    found = getattr(package, name)
    home = getattr(found, "__module__", shown)
    if not home.startswith("asia.") or not hasattr(import_module(home), name):
        home = shown
    return (
        f"::: {home}.{name}\n    options:\n      heading: {shown}.{name}\n      heading_level: 3\n"
    )


def _module(name: str) -> str:
    return (
        f"::: {name}\n    options:\n      heading: {name}\n      heading_level: 3\n"
        "      members: [Config, build, train]\n"
    )
