"""Training methods by name, and the method of settings; other packages register methods as "rlftsim.methods"."""

from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.plugins import ExtensionPoint
from rlftsim.training.method import Method

SHIPPED = {
    "rlft": "rlftsim.training.reward:RewardMethod",
    "catk": "rlftsim.training.catk:CatkMethod",
    "road": "rlftsim.training.catk:RoadMethod",
    "gcsl": "rlftsim.training.goal_relabeling:GcslMethod",
    "distill": "rlftsim.training.distill:DistillMethod",
    "calibrate": "rlftsim.training.calibrate:CalibrateMethod",
    "pretrain": "rlftsim.training.imitation:PretrainMethod",
}
"""Methods of this package, name to "module:class"."""
METHODS: ExtensionPoint[type[Method[Any]]] = ExtensionPoint(
    "method", "rlftsim.methods", SHIPPED, use=lambda name: method_by_name(name)
)
"""Training methods by name."""


def method_by_name(name: str) -> Method[Any]:
    """The training method of a name, installed packages included.

    Raises:
        ConfigError: Unknown, with the nearest registered name; or no training method.
    """
    method = METHODS.get(name)
    missing = [member for member in ("settings", "title", "start", "update") if not hasattr(method, member)]
    if missing:
        raise ConfigError(
            f"method {name!r} has no {' and no '.join(missing)}: make it extend rlftsim.training.method.Method."
        )
    return method()


def find_method(settings: object) -> Method[Any] | None:
    """The training method of settings, by type or else by the nearest base class; None for settings of no method."""
    for settings_type in type(settings).__mro__:
        # Methods of other packages come last: a look at them imports all these packages.
        for list_names in (lambda: list(SHIPPED), METHODS.names):
            for name in list_names():
                if getattr(METHODS.get(name), "settings", None) is settings_type:
                    return method_by_name(name)
    return None
