"""What every kind of certificate must do, whatever it certifies."""

import dataclasses
import functools
import inspect
import json
import re

import jax.numpy as jnp
import numpy as np
import pytest

import perfcontrol as pc
from perfcontrol.theory import certificate_row
from tests.theory.problems import random_problem
from tests.tools import assert_refused

ARGUMENT = re.compile(r"\b\w+=\S|\bpc\.\w+")  # what to pass, by name


class CertificateContract:
    """Inherit and set `kind`, a class; `settings` only where it needs some to be quick."""

    kind: type[pc.AbstractCertificateKind]
    settings: dict = {}  # noqa: RUF012
    shorthand = True  # whether `pc.certify` knows the kind by its name

    @staticmethod
    def applicable(strength: float = 1e-4) -> pc.PerformativeProblem:
        """A problem that meets the assumptions; strength: of its reaction."""
        return random_problem(3, strength=strength)

    @staticmethod
    def inapplicable() -> pc.PerformativeProblem:
        """A problem that does not."""
        base = random_problem(3, strength=1e-4, bounded=False)
        return pc.PerformativeProblem(
            system=base.system,
            horizon=base.horizon,
            memory=base.memory,
            noise=pc.Gaussian(np.zeros(2), np.eye(2)),
            cost=pc.ConvexCost(lambda t, x, u: jnp.sum(jnp.cosh(x)) + jnp.sum(u**2)),
            perturbation=pc.SampledPerturbation(lambda key, M: jnp.zeros((base.horizon, 2, 2))),
        )

    @classmethod
    @functools.cache
    def certificate(cls, strength: float = 1e-4) -> pc.Certificate:
        return pc.certify(cls.applicable(strength), cls.kind(**cls.settings))

    @classmethod
    @functools.cache
    def refusal(cls) -> pc.Certificate:
        return pc.certify(cls.inapplicable(), cls.kind(**cls.settings))

    def test_certificate_holds_where_left_is_below_right_and_the_rate_is_their_ratio(self):
        certificate = self.certificate()
        assert certificate.applicable and certificate.missing == () and certificate.kind == self.kind.name
        assert certificate.holds is (certificate.lhs < certificate.rhs)
        assert certificate.margin == certificate.rhs - certificate.lhs
        assert certificate.rate == pytest.approx(certificate.lhs / certificate.rhs)
        if certificate.weights is not None:
            assert certificate.contributions.sum() == pytest.approx(certificate.lhs)

    def test_certificate_without_reaction_holds_with_rate_zero(self):
        certificate = self.certificate(0.0)
        assert certificate.holds is True and certificate.rate == pytest.approx(0, abs=1e-12)
        assert certificate.exists is True

    def test_certified_rate_is_not_below_that_of_repeated_minimisation(self):
        problem = self.applicable()
        stable = pc.solve(problem, pc.RRM()).M
        M, errors = stable + 1e-3 * problem.initial_policy() + 1e-4, []
        for _ in range(2):
            M = pc.best_response(problem, problem.feasible_set.project(M))
            errors.append(float(jnp.linalg.norm(M - stable)))
        assert errors[1] <= self.certificate().rate * errors[0] * (1 + 1e-6) + 1e-14

    def test_certificate_reads_as_a_paragraph_and_says_how_each_fact_is_known(self):
        certificate = self.certificate()
        text = str(certificate)
        assert text.startswith(self.kind.title) and text.endswith(".") and certificate.existence in text
        assert certificate.assumptions
        for item in certificate.assumptions:
            assert item.status in ("proved", "declared", "estimated") and str(item) in text

    def test_certificate_that_is_not_applicable_says_what_to_pass_and_claims_nothing(self):
        refusal = self.refusal()
        assert refusal.applicable is False and refusal.missing
        numbers = ("holds", "lhs", "rhs", "margin", "rate", "weights", "contributions")
        assert all(getattr(refusal, name) is None for name in numbers)
        for reason in refusal.missing:
            assert ARGUMENT.search(reason), f"names no argument: {reason}"
            assert reason in str(refusal)
        assert "says nothing against the problem" in str(refusal)

    def test_certificates_are_plain_data_for_reports(self):
        for certificate in (self.certificate(), self.refusal()):
            row = certificate_row(certificate)
            assert json.loads(json.dumps(row)) == row

    def test_kind_is_frozen_and_documents_every_setting(self):
        kind = self.kind(**self.settings)
        names = [field.name for field in dataclasses.fields(kind)]
        assert list(inspect.signature(self.kind).parameters) == names
        for name in names:
            with pytest.raises(dataclasses.FrozenInstanceError):
                setattr(kind, name, 1)
            assert re.search(rf"^ *{name}: ", inspect.getdoc(self.kind), re.MULTILINE), f"{name} is not documented"

    def test_misspelt_setting_names_the_nearest_one(self):
        for field in dataclasses.fields(self.kind):
            wrong = field.name + "s"
            assert_refused(lambda wrong=wrong: self.kind(**{wrong: 1}), wrong, f"did you mean `{field.name}`")

    def test_kind_is_refused_as_a_class_and_with_settings_beside_it(self):
        problem = self.applicable()
        assert_refused(lambda: pc.certify(problem, self.kind), "kind", f"pc.{self.kind.__name__}()")
        assert_refused(lambda: pc.certify(problem, self.kind(**self.settings), batch=2), "batch", self.kind.__name__)
        assert_refused(lambda: pc.certify(None, self.kind(**self.settings)), "problem", "PerformativeProblem")

    def test_name_is_the_shorthand_of_the_object(self):
        if not self.shorthand:
            pytest.skip("known as an object only")
        named = pc.certify(self.applicable(), self.kind.name, **self.settings)
        assert certificate_row(named) == certificate_row(self.certificate())
