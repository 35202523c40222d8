"""Host and program: known numbers are worked on from the host by a few compiled programs, traced ones inside yours.

A recursion over time is worth compiling; a handful of small matrices is not. Code that needs both is written once:
`program` compiles a pure function, once for all its callers, when its arguments are known, and inlines it when they
are traced; `cond`, `while_loop` and `choose` are Python's where their operands are known; `numerics` gives NumPy and
SciPy, or their JAX twins.
"""

import functools
from collections.abc import Callable
from types import ModuleType
from typing import TYPE_CHECKING, Any

import jax
import jax.core
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
import scipy.linalg

if TYPE_CHECKING:
    Numbers = Any  # the common part of what JAX's and NumPy's stubs promise is too small to compute with
else:
    Numbers = jax.Array | np.ndarray | np.generic  # known, or traced

# XLA's newer emitters for the CPU take twice as long to compile these programs and run them no faster, save where many
# numbers lie side by side.
QUICK = {"xla_cpu_use_fusion_emitters": False}
# What LLVM does above its second level takes a tenth to two thirds of the time to compile, and serves loops that draw.
LESS = {"xla_backend_optimization_level": 2}


def known(*trees: Any) -> bool:
    """Whether every number in `trees` has a value: False where anything is traced."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(trees))


@functools.cache
def compiler_options(quick: bool = True, whole: bool = True) -> dict[str, Any]:
    """`QUICK`, and `LESS` without the `whole` effort, where this version of XLA knows them."""
    wanted = (QUICK if quick else {}) | ({} if whole else LESS)
    try:
        jax.jit(lambda: 0, compiler_options=wanted).lower().compile()
    except Exception:  # whatever it says, the options are not essential
        return {}
    return wanted


def _is_array(leaf: Any) -> bool:
    return isinstance(leaf, jax.Array | np.ndarray | np.generic)


class Program:
    """A pure function, compiled on first use for each kind of arguments; arrays are inputs, all else is fixed.

    Known arguments give NumPy arrays (JAX arrays with `on_device=True`); traced ones are worked on in place. `quick`
    and `whole` are those of `compiler_options`.
    """

    def __init__(self, function: Callable, on_device: bool, quick: bool, whole: bool):
        functools.update_wrapper(self, function)
        self.function, self.on_device, self.quick, self.whole = function, on_device, quick, whole

    def _jit(self, **options: Any) -> Callable:
        def run(fixed: tuple[Any, tuple], inputs: list) -> Any:
            structure, others = fixed
            pairs = zip(inputs, others, strict=True)
            leaves = [other if array is None else jnp.asarray(array) for array, other in pairs]
            return self.function(*jax.tree.unflatten(structure, leaves))

        run.__name__ = self.function.__name__
        return jax.jit(run, static_argnums=0, **options)

    @functools.cached_property
    def _standing(self) -> Callable:
        return self._jit(compiler_options=compiler_options(self.quick, self.whole))

    @functools.cached_property
    def _inlined(self) -> Callable:
        return self._jit(inline=True)

    def __call__(self, *arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        inputs = [leaf if _is_array(leaf) else None for leaf in leaves]
        fixed = structure, tuple(None if _is_array(leaf) else leaf for leaf in leaves)
        if not known(inputs):
            return self._inlined(fixed, inputs)
        answer = self._stand(fixed, inputs)
        return answer if self.on_device else jax.tree.map(np.asarray, answer)

    def _stand(self, fixed: Any, inputs: list) -> Any:
        try:
            answer = self._standing(fixed, inputs)
            if known(answer):
                return answer
        except ValueError:  # JAX refuses compiler options inside somebody else's trace
            pass
        with jax.ensure_compile_time_eval():  # there, known numbers stay known
            return self._standing(fixed, inputs)


def program(
    function: Callable | None = None, *, on_device: bool = False, quick: bool = True, whole: bool | None = None
) -> Any:
    """Make `function` a `Program`; with `on_device=True` its answers stay JAX arrays, and it is taken for long work,
    which is worth the `whole` effort of the compiler unless told otherwise."""
    if function is None:
        return functools.partial(program, on_device=on_device, quick=quick, whole=whole)
    return Program(function, on_device, quick, on_device if whole is None else whole)


def numerics(*trees: Any) -> tuple[ModuleType, ModuleType]:
    """The array module and the linear algebra for these numbers: NumPy and SciPy's, or JAX's."""
    return (np, scipy.linalg) if known(*trees) else (jnp, jax.scipy.linalg)


def on_host(tree: Any) -> Any:
    """Known JAX arrays as NumPy arrays; traced ones as they are."""
    return jax.tree.map(lambda leaf: np.asarray(leaf) if isinstance(leaf, jax.Array) and known(leaf) else leaf, tree)


def choose(condition: Any, yes: Any, no: Any) -> Any:
    """`yes` or `no`, leaf by leaf."""
    if known(condition):
        return yes if condition else no
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)


def cond(condition: Any, yes: Callable[[], Any], no: Callable[[], Any]) -> Any:
    """yes() or no()."""
    if known(condition):
        return yes() if condition else no()
    return jax.lax.cond(condition, yes, no)


def while_loop(unfinished: Callable[[Any], Any], body: Callable[[Any], Any], carry: Any) -> Any:
    """`carry` after as many rounds of `body` as `unfinished` asks for."""
    if not known(carry):
        return jax.lax.while_loop(unfinished, body, carry)
    while unfinished(carry):
        carry = body(carry)
    return carry
