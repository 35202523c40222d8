"""Perturbation laws D_t(M): the interface and one file a family."""

from perfcontrol.perturbations.base import AbstractPerturbation, CovarianceOperator, DenseDraws, Draws, PathDraws
from perfcontrol.perturbations.dense import DensePerturbation
from perfcontrol.perturbations.directional import DirectionalPerturbation
from perfcontrol.perturbations.finite import FinitePerturbation
from perfcontrol.perturbations.fitted import fitted_perturbation as fitted_perturbation
from perfcontrol.perturbations.none import NoPerturbation
from perfcontrol.perturbations.sampled import SampledPerturbation
from perfcontrol.perturbations.stock import StockPerturbation

__all__ = [
    "AbstractPerturbation",
    "CovarianceOperator",
    "DenseDraws",
    "DensePerturbation",
    "DirectionalPerturbation",
    "Draws",
    "FinitePerturbation",
    "NoPerturbation",
    "PathDraws",
    "SampledPerturbation",
    "StockPerturbation",
]
