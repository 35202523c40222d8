"""Every public part fulfils the contract of its kind: a class without a row fails here."""

import importlib
import inspect
from pathlib import Path

import pytest

import perfcontrol as pc
from tests.contracts.certificate import CertificateContract
from tests.contracts.cost import CostContract
from tests.contracts.feasible_set import SetContract
from tests.contracts.perturbation import PerturbationContract
from tests.contracts.policy_map import PolicyMapContract
from tests.contracts.random_vector import RandomVectorContract
from tests.contracts.solver import SolverContract
from tests.contracts.structure import StructureContract

KINDS = {
    "law": (pc.AbstractRandomVector, RandomVectorContract, lambda row: type(row.law())),
    "map": (pc.AbstractPolicyMap, PolicyMapContract, lambda row: type(row.policy_map())),
    "set": (pc.AbstractSet, SetContract, lambda row: type(row.feasible_set())),
    "structure": (pc.AbstractStructure, StructureContract, lambda row: type(row.structure())),
    "cost": (pc.AbstractCost, CostContract, lambda row: type(row.cost())),
    "perturbation": (pc.AbstractPerturbation, PerturbationContract, lambda row: type(row.perturbation())),
    "solver": (pc.AbstractSolver, SolverContract, lambda row: type(row.solver())),
    "certificate": (pc.AbstractCertificateKind, CertificateContract, lambda row: row.kind),
}


def rows(contract: type) -> list[type]:
    """The classes that the test files derive from a contract."""
    for path in Path(__file__).parent.rglob("test_*.py"):
        if path != Path(__file__) and contract.__module__ in path.read_text():
            importlib.import_module(".".join(("tests", *path.relative_to(Path(__file__).parent).with_suffix("").parts)))
    found, waiting = [], [contract]
    while waiting:
        below = waiting.pop().__subclasses__()
        waiting += below
        found += [row for row in below if row.__name__.startswith("Test")]
    return found


@pytest.mark.parametrize("kind", KINDS)
def test_every_public_class_has_a_row_in_the_contract_of_its_kind(kind):
    interface, contract, part = KINDS[kind]
    public = {value for name in pc.__all__ if inspect.isclass(value := getattr(pc, name))}
    parts = {value for value in public if issubclass(value, interface) and not inspect.isabstract(value)}
    assert parts, "the interface has no public parts"
    missing = parts - {part(row()) for row in rows(contract)}
    assert not missing, f"without a row: {sorted(value.__name__ for value in missing)}"
