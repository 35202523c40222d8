"""Identification: from logs of a few deployments to a problem with its uncertainty."""

from perfcontrol.fit.identify import fit
from perfcontrol.fit.logs import Logs
from perfcontrol.fit.result import Fit

__all__ = ["Fit", "Logs", "fit"]
