"""Runs exported for other tools."""
