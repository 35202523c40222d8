"""Settings of long runs, checked before work starts."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

REGIMES = {"stable": 0.9, "unstable": 1.0, "general": 0.96}  # growth ρ in A = ρ I


class ReproduceSettings(BaseModel):
    """What `perfcontrol reproduce` runs. The step multiplies the gradient averaged over the stages.

    The defaults are the paper's numbers where it gives them, else the completions described in
    `perfcontrol.experiments.stock`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    seeds: int = Field(default=32, ge=2, description="independent runs of each case")
    steps: int = Field(default=1000, ge=100, description="iterations N of each run")
    step_size: float = Field(default=0.01, gt=0, description="constant step on the stage average")
    feasible_set: Literal["rows", "simplex"] = Field(default="rows", description="row sums, or nonnegative as well")
    initial_investment: float = Field(default=150.0, gt=0, description="q_1 of every stock")
    rate: float = Field(default=0.05, description="riskless rate over the horizon")
    trading_hours: float = Field(default=6.5, gt=0, lt=24, description="h, trading hours a day")
    cure_seeds: int = Field(default=10, ge=2, description="runs of each case that show what cures divergence")
    cure_steps: int = Field(default=3000, ge=100, description="iterations of those with a diminishing step")
    sweep_seeds: int = Field(
        default=8, ge=2, description="runs per step size in the search for where divergence begins"
    )
    sweep_steps: int = Field(default=400, ge=50, description="iterations of each of those")
    simplex: bool = Field(default=True, description="the bounded set as well: its stable points, and as a cure")
    seed: int = Field(default=0, ge=0, description="root of all randomness")

    @classmethod
    def quick(cls) -> "ReproduceSettings":
        """Small enough to end within seconds; the verdicts are then computed from little data."""
        return cls(seeds=4, steps=200, cure_seeds=4, cure_steps=300, sweep_seeds=2, sweep_steps=100, simplex=False)
