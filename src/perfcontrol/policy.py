"""The disturbance-action law u_t = -K_t x_t + Σ_{i=1..H} M[i-1] w_{t-i}, with w_j = 0 for j < 0.

One law for every user of it: `init`/`act`/`observe` step by step (a running plant, an environment), and
`feedforward` for a whole path at once (simulation, exact evaluation).
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from perfcontrol._checks import fail
from perfcontrol._linalg import matvec


class DisturbanceAction(eqx.Module):
    """The law in steps: `memory = policy.init()`, `u = policy.act(memory, x, t)`, `memory = policy.observe(memory, w)`.

    Args:
        gain: K, (m, n), or (T+1, m, n).
        M: the full policy (H, m, n).

    Raises:
        InputError: shapes that do not fit.
    """

    gain: Array
    M: Float[Array, "H m n"]

    def __check_init__(self) -> None:
        if self.M.ndim != 3:
            raise fail("M", f"{self.M.shape}", "be a full policy of shape (H, m, n)", "Add the lag axis: M[None].")
        if self.gain.shape[-2:] != self.M.shape[1:] or self.gain.ndim not in (2, 3):
            required = f"have shape (m, n) = {self.M.shape[1:]}, or (T+1, m, n)"
            raise fail("gain", f"{self.gain.shape}", required, "Pass one that fits M, (H, m, n).")

    def init(self) -> Float[Array, "H n"]:
        """The empty memory: row i-1 holds w_{t-i}."""
        return jnp.zeros((self.M.shape[0], self.M.shape[2]), self.M.dtype)

    def act(self, memory: Float[Array, "H n"], x: Float[Array, " n"], t: Int[Array, ""] | int = 0) -> Array:
        """u_t."""
        gain = self.gain if self.gain.ndim == 2 else self.gain[t]
        return jnp.einsum("imn,in->m", self.M, memory) - matvec(gain, x)

    def observe(self, memory: Float[Array, "H n"], w: Float[Array, " n"]) -> Float[Array, "H n"]:
        """The memory after the disturbance w_t became known."""
        return jnp.concatenate([w[None], memory[:-1]])


def lagged(w: Float[Array, "T n"], memory: int) -> Float[Array, "T1 H n"]:
    """lagged(w, H)[t, i-1] = w_{t-i} for t = 0..T, zero where t < i.

    Examples:
        >>> lagged(jnp.array([[1.0], [2.0], [3.0]]), memory=2)[..., 0].tolist()
        [[0.0, 0.0], [1.0, 0.0], [2.0, 1.0], [3.0, 2.0]]
    """
    horizon = w.shape[0]
    padded = jnp.concatenate([jnp.zeros((memory, w.shape[1]), w.dtype), w])
    return jnp.stack([padded[memory - i : memory - i + horizon + 1] for i in range(1, memory + 1)], axis=1)


def feedforward(M: Float[Array, "H m n"], w: Float[Array, "T n"]) -> Float[Array, "T1 m"]:
    """v_t = Σ_i M[i-1] w_{t-i} for t = 0..T."""
    return jnp.einsum("imn,tin->tm", M, lagged(w, M.shape[0]))


def feedforward_adjoint(h: Float[Array, "T1 m"], w: Float[Array, "T n"], memory: int) -> Float[Array, "H m n"]:
    """Σ_t h_t w_{t-i}ᵀ: the adjoint of `feedforward` in M."""
    return jnp.einsum("tm,tin->imn", h, lagged(w, memory))
