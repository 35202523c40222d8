"""Control of a running plant: act, observe, learn between episodes, deploy what the model allows."""

from perfcontrol._calls import explain_calls
from perfcontrol.online.controller import Controller
from perfcontrol.online.gate import Gate
from perfcontrol.online.state import ControllerState, Entry

__all__ = ["Controller", "ControllerState", "Entry", "Gate"]

explain_calls(__name__, globals(), __all__)
