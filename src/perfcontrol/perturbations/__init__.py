"""Perturbation laws D_t(M): the interface and one file a family."""

from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, Draws
from perfcontrol.perturbations.directional import DirectionalPerturbation
from perfcontrol.perturbations.none import NoPerturbation
from perfcontrol.perturbations.stock import StockPerturbation

__all__ = [
    "AbstractPerturbation",
    "CovarianceOperator",
    "DirectionalPerturbation",
    "Draws",
    "NoPerturbation",
    "StockPerturbation",
]
