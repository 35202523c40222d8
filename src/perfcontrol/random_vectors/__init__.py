"""Laws of random vectors: the interface and one file a law."""

from perfcontrol.random_vectors.base import AbstractRandomVector
from perfcontrol.random_vectors.constant import Constant
from perfcontrol.random_vectors.empirical import Empirical
from perfcontrol.random_vectors.fitted import fitted_vector as fitted_vector
from perfcontrol.random_vectors.gaussian import Gaussian
from perfcontrol.random_vectors.linear import Linear
from perfcontrol.random_vectors.log_normal import LogNormal
from perfcontrol.random_vectors.rademacher import Rademacher
from perfcontrol.random_vectors.rademacher import random_signs as random_signs
from perfcontrol.random_vectors.sequence import Sequence
from perfcontrol.random_vectors.stochastic_volatility import StochasticVolatility
from perfcontrol.random_vectors.truncated_gaussian import TruncatedGaussian
from perfcontrol.random_vectors.uniform import Uniform

__all__ = [
    "AbstractRandomVector",
    "Constant",
    "Empirical",
    "Gaussian",
    "Linear",
    "LogNormal",
    "Rademacher",
    "Sequence",
    "StochasticVolatility",
    "TruncatedGaussian",
    "Uniform",
]
