"""The paper's experiment, reproduced: `reproduce(folder, settings)`."""

from perfcontrol.experiments.reproduce.run import Outcome, reproduce

__all__ = ["Outcome", "reproduce"]
