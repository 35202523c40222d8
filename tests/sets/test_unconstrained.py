import perfcontrol as pc
from tests.contracts.feasible_set import SetContract


class TestUnconstrained(SetContract):
    def feasible_set(self):
        return pc.Unconstrained()

    def constraints(self, M):
        return []
