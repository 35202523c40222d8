"""An estimated parameter with its interval: from what every unit contributed to it."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import special

from perfcontrol._checks import fail
from perfcontrol.evaluate import Estimate


class Parameter(Estimate):
    """A parameter of a fit.

    Attributes:
        mean: any shape.
        standard_error: the same shape; infinite where the logs do not tell.
        degrees_of_freedom: the same shape; of the standard error, few where few episodes carry the information.
    """

    degrees_of_freedom: Float[Array, "..."]

    def interval(self, level: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Ends of the interval by the t law, of the shape of `mean`.

        Args:
            level: how often it should hold the truth.
        """
        if not (isinstance(level, int | float) and 0 < level < 1):
            raise fail("level", repr(level), "be a number between 0 and 1", "Pass for example level=0.95.")
        degrees = np.minimum(np.asarray(self.degrees_of_freedom, dtype=float), 1e9)
        reach = special.stdtrit(degrees, (1 + level) / 2) * np.asarray(self.standard_error, dtype=float)
        mean = np.asarray(self.mean, dtype=float)
        return mean - reach, mean + reach


def parameter(mean: np.ndarray, influence: np.ndarray, unknown: np.ndarray | bool = False) -> Parameter:
    """From the influence (U, *shape) of every unit, as `blocks.Block` has it; `unknown`: what the logs do not tell.

    The squares h_u² of the influences add up to the variance. Their sum has itself a relative variance, by their fourth
    powers Σ h⁴ / (Σ h²)² - 1/U, which is 2/ν for ν degrees of freedom (Satterthwaite).
    """
    count = len(influence)
    squares = np.sum(influence**2, axis=0)
    known = squares > 0
    fourth = np.sum(influence**4, axis=0) / np.where(known, squares, 1.0) ** 2
    relative = np.where(known, fourth - 1 / count, 0.0)
    degrees = np.where(relative > 2e-9, 2 / np.maximum(relative, 2e-9), np.inf)
    errors = np.where(unknown, np.inf, np.sqrt(squares * (count - 1) / count))
    return Parameter(jnp.asarray(mean), jnp.asarray(errors), jnp.asarray(degrees))
