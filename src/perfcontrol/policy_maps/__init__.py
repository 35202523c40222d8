"""How a quantity depends on the policy: the interface and one file a map."""

from perfcontrol.policy_maps.affine import Affine
from perfcontrol.policy_maps.base import AbstractPolicyMap
from perfcontrol.policy_maps.constant import ConstantMap as ConstantMap
from perfcontrol.policy_maps.convert import as_policy_map as as_policy_map
from perfcontrol.policy_maps.convert import evaluate_map as evaluate_map
from perfcontrol.policy_maps.function import Function
from perfcontrol.policy_maps.norm import Norm

__all__ = ["AbstractPolicyMap", "Affine", "Function", "Norm"]
