"""Precision of the test run: float64 unless PERFCONTROL_TEST_X64=0."""

import os

import jax

jax.config.update("jax_enable_x64", os.environ.get("PERFCONTROL_TEST_X64", "1") == "1")
