"""The world of a problem as a Gymnasium environment, in which the exact answer is known.

Gymnasium is imported when `register` is called or a class is asked for, and not before; from then on it knows the name
"perfcontrol/PerformativeLDS-v0".
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from perfcontrol._calls import explain_call

if TYPE_CHECKING:
    from perfcontrol.environments.single import PerformativeLDS
    from perfcontrol.environments.vector import VectorPerformativeLDS

__all__ = ["PerformativeLDS", "VectorPerformativeLDS", "register"]

ID = "perfcontrol/PerformativeLDS-v0"
PLACES = {"PerformativeLDS": "single", "VectorPerformativeLDS": "vector"}


def register() -> None:
    """Make "perfcontrol/PerformativeLDS-v0" known to `gymnasium.make` and `gymnasium.make_vec`; again does no harm.

    Raises:
        ImportError: Gymnasium is not installed.
    """
    gymnasium = _gymnasium()
    if ID not in gymnasium.registry:
        single, vector = (f"{__name__}.{PLACES[name]}:{name}" for name in PLACES)
        gymnasium.register(id=ID, entry_point=single, vector_entry_point=vector)


def _gymnasium() -> Any:
    try:
        return import_module("gymnasium")
    except ImportError as error:
        raise ImportError("perfcontrol.environments needs Gymnasium: pip install 'perfcontrol[interop]'.") from error


def __getattr__(name: str) -> Any:
    if name not in PLACES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}", name=name)
    register()
    value = getattr(import_module(f"{__name__}.{PLACES[name]}"), name)
    globals()[name] = explain_call(__name__, name, value)
    return globals()[name]
