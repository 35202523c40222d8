"""A fast generator behind JAX's own keys: every number is a function of a key and a counter, and nothing is kept.

With all arithmetic in the integers modulo 2⁶⁴, a key is a pair (a, b). It stands for the odd multiplier k = a | 1 and
the first counter s = b + 2⁶³ (a mod 2); its number i is F(x, x + k) with x = (s + i) k. F is a fixed function, four
rounds of squaring for 32 bits and five for 64 ("Squares": B. Widynski, arXiv:2004.06278).

Streams that cannot overlap: from x and z = x + k follow k = z - x and, k being odd, s + i = x k⁻¹. So F meets one point
twice only where multiplier and counter agree. Children of a key by `fold_in` have a_d = mix(a + g (2d + 1)), with a
bijection `mix`, an odd g, and the same b for all d: these a_d differ. Two of them have one multiplier only if they
differ in their last bit alone; then their first counters are 2⁶³ apart. Hence children of one key never meet while each
draws fewer than 2⁶³ numbers. The same holds for `split`. Keys that are no such siblings are told apart by chance, as in
every generator: of N keys that draw L numbers each, two meet with a probability of about N² L / 2¹²⁷.
"""

import functools
import math
from collections.abc import Callable
from importlib import import_module
from typing import Any

import jax
import jax.extend
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float, Key, UInt32, UInt64

from perfcontrol._checks import fail

FOLD = np.uint64(0x9E3779B97F4A7C15)
SPLIT = np.uint64(0xD1B54A32D192ED03)
LOW = np.uint64(0xFFFFFFFF)
HALF = np.uint64(32)
# JAX kept it in its experimental part at first.
ENABLE_X64: Any = jax.enable_x64 if hasattr(jax, "enable_x64") else import_module("jax.experimental").enable_x64
WIDTHS = {8: np.uint8, 16: np.uint16, 32: np.uint32, 64: np.uint64}


def _in_64_bits(function: Callable) -> Callable:
    """The function with 64-bit integers, whatever the user's precision is: the numbers do not depend on it."""

    def wide(*arguments: Any) -> Any:
        with ENABLE_X64(True):
            return function(*arguments)

    return wide


def _mix(z: Array) -> Array:
    """A bijection of 64-bit words; every bit of z moves about half of the bits (the finaliser of SplitMix64)."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def _pair(key: UInt32[Array, "4 *keys"]) -> tuple[Array, Array]:
    words = key.astype(np.uint64)
    return (words[0] << HALF) | words[1], (words[2] << HALF) | words[3]


def _words(a: Array, b: Array) -> UInt32[Array, "*shape 4"]:
    return jnp.stack([a >> HALF, a & LOW, b >> HALF, b & LOW], axis=-1).astype(np.uint32)


@_in_64_bits
@jax.jit
def _seed(seed: Any) -> UInt32[Array, "4"]:
    a = _mix(lax.convert_element_type(seed, np.uint64) + FOLD)
    return _words(a, _mix(a + FOLD))


def _children(key: UInt32[Array, "4"], numbers: UInt64[Array, "*shape"], odd: np.uint64) -> UInt32[Array, "*shape 4"]:
    a, b = _pair(key)
    return _words(
        _mix(a + odd * (np.uint64(2) * numbers + np.uint64(1))), jnp.broadcast_to(_mix(b + odd), numbers.shape)
    )


@_in_64_bits
def _fold_in(key: UInt32[Array, "4"], data: Any) -> UInt32[Array, "4"]:
    return _children(key, lax.convert_element_type(data, np.uint64), FOLD)


@_in_64_bits
def _split(key: UInt32[Array, "4"], shape: tuple[int, ...]) -> UInt32[Array, "*shape 4"]:
    return _children(key, lax.iota(np.uint64, math.prod(shape)).reshape(shape), SPLIT)


@_in_64_bits
def _random_bits(key: UInt32[Array, "4"], width: int, shape: tuple[int, ...]) -> Array:
    return _numbers(key, width, lax.iota(np.uint64, math.prod(shape)).reshape(shape))


def _numbers(key: UInt32[Array, "4 *keys"], width: int, which: UInt64[Array, "..."]) -> Array:
    a, b = _pair(key)
    k = a | np.uint64(1)
    counter = b + (a << np.uint64(63)) + which
    x = y = counter * k
    z = y + k
    for step in (y, z, y):
        x = x * x + step
        x = (x >> HALF) | (x << HALF)
    x = x * x + z
    if width == 64:
        swapped = (x >> HALF) | (x << HALF)
        return x ^ ((swapped * swapped + y) >> HALF)
    return (x >> HALF).astype(WIDTHS[width])


SQUARES = jax.extend.random.define_prng_impl(
    key_shape=(4,), seed=_seed, split=_split, random_bits=_random_bits, fold_in=_fold_in, name="squares", tag="sq"
)


def fast_key(seed: Any) -> Key[Array, ""]:
    """A JAX random key whose numbers cost a fraction of those of `jax.random.key(seed)`.

    It goes wherever a key goes, in this package and in `jax.random`: `split`, `fold_in`, `vmap`, `jit` and `scan` work
    alike, in double and in single precision, on every device, and the numbers depend on the key alone and not on
    batching, device or precision. Keys made from one key by `fold_in`, or by `split`, have streams that cannot overlap.
    Not for secrets.

    Args:
        seed: integer from -2⁶³ to 2⁶³ - 1.

    Raises:
        InputError: a seed that is no such integer.

    References:
        B. Widynski, *Squares: a fast counter-based RNG*, arXiv:2004.06278; the keys are this module's own.

    Examples:
        >>> import jax
        >>> import perfcontrol as pc
        >>> jax.random.uniform(pc.fast_key(0), (2,)).shape
        (2,)
    """
    whole = seed if isinstance(seed, jax.Array) else np.asarray(seed)
    fits = whole.shape == () and jnp.issubdtype(whole.dtype, jnp.integer)
    if not fits or (whole.dtype == np.uint64 and not isinstance(seed, jax.Array) and whole >= 2**63):
        raise fail("seed", repr(seed), "be an integer of 64 bits", "Pass a whole number, as in pc.fast_key(0).")
    return jax.random.wrap_key_data(_seed(whole), impl=SQUARES)


def rearranged(keys: Key[Array, "*keys"], arrange: Callable[[np.ndarray], np.ndarray]) -> Key[Array, "..."]:
    """The keys whose words are `arrange` of those of `keys`, (*keys, words): on the host, where nothing is compiled."""
    words = arrange(np.asarray(jax.random.key_data(keys)))
    return jax.random.wrap_key_data(jax.device_put(words), impl=jax.random.key_impl(keys))


def is_fast(keys: Key[Array, "*keys"]) -> bool:
    """Whether the keys are those of `fast_key`."""
    return jax.random.key_impl(keys) == _kind()


@functools.cache
def _kind() -> Any:
    return jax.random.key_impl(jax.random.wrap_key_data(jnp.zeros(4, np.uint32), impl=SQUARES))


def random_words(keys: Key[Array, "*keys"], count: int, width: int) -> UInt32[Array, "count *keys"] | Array:
    """`jax.random.bits(key, (count,))`, numbers of `width` bits, of one key or of several side by side."""
    if keys.ndim == 0:
        return jax.random.bits(keys, (count,), WIDTHS[width])
    if is_fast(keys):
        data = jnp.moveaxis(jax.random.key_data(keys), -1, 0)
        return _in_64_bits(lambda data: _numbers(data, width, lax.iota(np.uint64, count)[:, None]))(data)
    return jax.vmap(lambda key: random_words(key, count, width), out_axes=-1)(keys)


def unit_numbers(keys: Key[Array, "*keys"], count: int, dtype: Any) -> Float[Array, "count *keys"]:
    """`jax.random.uniform(key, (count,), dtype)`, in [0, 1), of one key or of several side by side."""
    width, digits = jnp.finfo(dtype).bits, jnp.finfo(dtype).nmant
    words = random_words(keys, count, width)
    # The highest bits of a word as the digits of a number in [1, 2).
    one = np.ones((), dtype).view(words.dtype)
    return lax.bitcast_convert_type((words >> np.array(width - digits, words.dtype)) | one, dtype) - 1
