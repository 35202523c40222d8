"""One plant as a Gymnasium environment."""

from typing import Any

import gymnasium
import numpy as np

from perfcontrol.environments.copies import Copies
from perfcontrol.problem import PerformativeProblem


class PerformativeLDS(gymnasium.Env):
    """The plant of a problem, which reacts to the policy that was deployed last; `gymnasium.make` knows it as
    "perfcontrol/PerformativeLDS-v0".

    Deploying is an event: `env.reset(options={"deploy": M})`. The plant reacts to M from then on, whatever inputs it
    is given, until another policy is deployed; at first to the feasible policy nearest to zero. An action is the whole
    input u_t, and an observation [x_t, w_{t-1}, ..., w_{t-H}], so that a policy, u = -K x + Σ M w, is linear in it. The
    reward is -c_t(x_t, u_t). An episode has T+1 steps, the last one for the terminal stage, and then terminates: the
    rewards sum to minus the cost of the path, whose mean is `pc.expected_cost` where the actions are those of the
    deployed policy.

    `info` holds, exactly and not sampled, `cost`: C(M; M) of the deployed policy; `regret_to_stable` and
    `regret_to_optimal`: how much more that is than what `pc.StablePoint` and `pc.PerformativeOptimum` reach (left out
    where they reach none; the first may be negative); after a step `A`, the matrix A_t + Δ_t of it.

    Args:
        problem: with a finite horizon; None for a small example.
        actions: "inputs", or "policies": an action is then a policy (projected on the feasible set), which is deployed
            and acts for a whole episode of the plant; the reward is minus the cost of that, the observation the policy
            deployed, and there is no end (`gymnasium.wrappers.TimeLimit`).
        regret: False leaves exact costs out of `info`, which need a quadratic cost and known moments.

    Raises:
        InputError: an infinite horizon; exact costs that are not known; later a policy to deploy, or an action, of the
            wrong shape, not finite, or (deployed) infeasible.
    """

    metadata = {"render_modes": []}  # noqa: RUF012

    def __init__(self, problem: PerformativeProblem | None = None, actions: str = "inputs", regret: bool = True):
        self._copies = Copies(problem, actions, regret, 1)
        self.observation_space, self.action_space = self._copies.spaces()

    @property
    def problem(self) -> PerformativeProblem:
        """The problem."""
        return self._copies.problem

    @property
    def deployed(self) -> np.ndarray:
        """The policy that the plant reacts to, free parameters."""
        return self._copies.deployed[0].copy()

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode; see the class for `options`."""
        super().reset(seed=seed)
        observation = self._copies.reset(self.np_random, options)[0]
        return observation, self._info({})

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One stage."""
        costs, ended, more = self._copies.act(action, self.np_random)
        return self._copies.observe()[0], -float(costs[0]), ended, False, self._info(more)

    def _info(self, more: dict[str, np.ndarray]) -> dict[str, Any]:
        exact = {name: float(value[0]) for name, value in self._copies.info().items()}
        return exact | {name: value[0] for name, value in more.items()}
