"""The statements of the paper's section "Numerical Experiments", and of its theorem and propositions."""

from perfcontrol.reports.paper.judge import judge

__all__ = ["judge"]
