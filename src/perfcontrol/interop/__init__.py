"""Systems of other packages in, policies out as theirs; each package is imported only by the call that needs it."""

from perfcontrol._calls import explain_calls
from perfcontrol.interop.controllers import to_control
from perfcontrol.interop.plants import from_control

__all__ = ["from_control", "to_control"]

explain_calls(__name__, globals(), __all__)
