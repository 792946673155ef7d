"""Runs handed on to the tools of others."""
