"""Certificates as plain data."""

import json

from perfcontrol.theory import verdict_rows
from tests.theory.problems import prediction_problem


def test_reports_are_plain_data():
    rows = verdict_rows(prediction_problem(0.5), ("paper", "rigorous", "global"))
    assert json.loads(json.dumps(rows)) == rows
    assert [row["kind"] for row in rows] == ["paper", "rigorous", "global"]
    assert all(row["applicable"] is False and row["missing"] for row in rows)
