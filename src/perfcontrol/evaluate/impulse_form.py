"""What impulses of constant covariance meet in a world."""

import equinox as eqx
from jaxtyping import Array, Float


class ImpulseForm(eqx.Module):
    """Σ_s of the quadratic forms that impulses w_s meet, for noise whose covariance is constant; of one in the limit.

    G: (H m, H m), F: (H m, n), a: (n, n): cost tr Σ (a + FᵀM̂ + M̂ᵀF + M̂ᵀG M̂), M̂ the (H m, n) stack of lags.
    """

    G: Float[Array, "Hm Hm"]
    F: Float[Array, "Hm n"]
    a: Float[Array, "n n"]
