"""Identification: from logs of a few deployments to a problem with its uncertainty."""

from perfcontrol.identification.decision import Decision
from perfcontrol.identification.identify import fit
from perfcontrol.identification.logs import Logs
from perfcontrol.identification.reaction_test import ReactionTest, test_reaction
from perfcontrol.identification.result import Fit

__all__ = ["Decision", "Fit", "Logs", "ReactionTest", "fit", "test_reaction"]
