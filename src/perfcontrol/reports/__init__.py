"""Reports on problems (`pc.report`); claims checked against data, and the tables that say so."""

from perfcontrol.reports.report import Report, report

__all__ = ["Report", "report"]
