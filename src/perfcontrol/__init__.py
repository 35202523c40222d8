"""Performative control of linear dynamical systems: policies that change the system they control.

Two policies are told apart everywhere: `M` is evaluated or improved, `deployed` is the one the world reacts to.
"""

from importlib import import_module
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # editors and type checkers read the list
    from perfcontrol._api import *  # noqa: F403
    from perfcontrol._api import __all__ as __all__


def __getattr__(name: str) -> Any:
    """What `_api` lists, and rooms such as `plotting`, when first asked for: the command line answers before JAX is
    there."""
    if name == "__all__" or not name.startswith("_"):
        api = import_module("perfcontrol._api")
        globals().update({public: getattr(api, public) for public in api.__all__}, __all__=api.__all__)
        if name in globals():
            return globals()[name]
        if find_spec(f"perfcontrol.{name}"):
            return import_module(f"perfcontrol.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__getattr__("__all__")})
